// Vec and Mask as several registers of AVX2, SSE2 or NEON, or as plain vectors; see simd.h.

#if defined(__AVX2__) && defined(__FMA__)
constexpr int kNative = 8;
#else
constexpr int kNative = 4;
#endif
constexpr int kParts = 16 / kNative;

typedef float NativeFloat __attribute__((vector_size(kNative * 4)));
typedef float UnalignedFloat __attribute__((vector_size(kNative * 4), aligned(4)));
typedef int32_t NativeInt __attribute__((vector_size(kNative * 4)));

struct Mask {
  NativeInt m[kParts];
};
struct Vec {
  NativeFloat v[kParts];
  Vec() = default;
  EXTRAGS_INLINE NativeFloat splat(float value) { return NativeFloat{} + value; }
  Vec(float value) {
    for (int i = 0; i < kParts; ++i) v[i] = splat(value);
  }
};

#define EXTRAGS_EACH(expression)                     \
  Vec r;                                             \
  for (int i = 0; i < kParts; ++i) r.v[i] = (expression); \
  return r
#define EXTRAGS_EACH_MASK(expression)                \
  Mask r;                                            \
  for (int i = 0; i < kParts; ++i) r.m[i] = (expression); \
  return r

#if defined(__AVX2__) && defined(__FMA__)
EXTRAGS_INLINE NativeFloat native_fma(NativeFloat a, NativeFloat b, NativeFloat c) {
  return _mm256_fmadd_ps(a, b, c);
}
EXTRAGS_INLINE NativeFloat native_fnma(NativeFloat a, NativeFloat b, NativeFloat c) {
  return _mm256_fnmadd_ps(a, b, c);
}
EXTRAGS_INLINE NativeFloat native_sqrt(NativeFloat a) { return _mm256_sqrt_ps(a); }
EXTRAGS_INLINE NativeFloat native_min(NativeFloat a, NativeFloat b) { return _mm256_min_ps(a, b); }
EXTRAGS_INLINE NativeFloat native_max(NativeFloat a, NativeFloat b) { return _mm256_max_ps(a, b); }
EXTRAGS_INLINE uint32_t native_bits(NativeInt m) {
  return static_cast<uint32_t>(_mm256_movemask_ps((__m256)m));
}
#elif defined(__aarch64__)
EXTRAGS_INLINE NativeFloat native_fma(NativeFloat a, NativeFloat b, NativeFloat c) {
  return (NativeFloat)vfmaq_f32((float32x4_t)c, (float32x4_t)a, (float32x4_t)b);
}
EXTRAGS_INLINE NativeFloat native_fnma(NativeFloat a, NativeFloat b, NativeFloat c) {
  return (NativeFloat)vfmsq_f32((float32x4_t)c, (float32x4_t)a, (float32x4_t)b);
}
EXTRAGS_INLINE NativeFloat native_sqrt(NativeFloat a) {
  return (NativeFloat)vsqrtq_f32((float32x4_t)a);
}
EXTRAGS_INLINE NativeFloat native_min(NativeFloat a, NativeFloat b) { return a < b ? a : b; }
EXTRAGS_INLINE NativeFloat native_max(NativeFloat a, NativeFloat b) { return a > b ? a : b; }
EXTRAGS_INLINE uint32_t native_bits(NativeInt m) {
  return (m[0] & 1) | (m[1] & 2) | (m[2] & 4) | (m[3] & 8);
}
#else
EXTRAGS_INLINE NativeFloat native_fma(NativeFloat a, NativeFloat b, NativeFloat c) {
  return a * b + c;
}
EXTRAGS_INLINE NativeFloat native_fnma(NativeFloat a, NativeFloat b, NativeFloat c) {
  return c - a * b;
}
#if defined(__SSE2__)
EXTRAGS_INLINE NativeFloat native_sqrt(NativeFloat a) { return _mm_sqrt_ps(a); }
EXTRAGS_INLINE NativeFloat native_min(NativeFloat a, NativeFloat b) { return _mm_min_ps(a, b); }
EXTRAGS_INLINE NativeFloat native_max(NativeFloat a, NativeFloat b) { return _mm_max_ps(a, b); }
EXTRAGS_INLINE uint32_t native_bits(NativeInt m) {
  return static_cast<uint32_t>(_mm_movemask_ps((__m128)m));
}
#else
EXTRAGS_INLINE NativeFloat native_sqrt(NativeFloat a) {
  for (int k = 0; k < kNative; ++k) a[k] = __builtin_sqrtf(a[k]);
  return a;
}
EXTRAGS_INLINE NativeFloat native_min(NativeFloat a, NativeFloat b) { return a < b ? a : b; }
EXTRAGS_INLINE NativeFloat native_max(NativeFloat a, NativeFloat b) { return a > b ? a : b; }
EXTRAGS_INLINE uint32_t native_bits(NativeInt m) {
  return (m[0] & 1) | (m[1] & 2) | (m[2] & 4) | (m[3] & 8);
}
#endif
#endif

EXTRAGS_INLINE Vec operator+(Vec a, Vec b) { EXTRAGS_EACH(a.v[i] + b.v[i]); }
EXTRAGS_INLINE Vec operator-(Vec a, Vec b) { EXTRAGS_EACH(a.v[i] - b.v[i]); }
EXTRAGS_INLINE Vec operator*(Vec a, Vec b) { EXTRAGS_EACH(a.v[i] * b.v[i]); }
EXTRAGS_INLINE Vec operator/(Vec a, Vec b) { EXTRAGS_EACH(a.v[i] / b.v[i]); }
EXTRAGS_INLINE Vec fma(Vec a, Vec b, Vec c) { EXTRAGS_EACH(native_fma(a.v[i], b.v[i], c.v[i])); }
EXTRAGS_INLINE Vec fnma(Vec a, Vec b, Vec c) { EXTRAGS_EACH(native_fnma(a.v[i], b.v[i], c.v[i])); }
EXTRAGS_INLINE Vec min(Vec a, Vec b) { EXTRAGS_EACH(native_min(a.v[i], b.v[i])); }
EXTRAGS_INLINE Vec max(Vec a, Vec b) { EXTRAGS_EACH(native_max(a.v[i], b.v[i])); }
EXTRAGS_INLINE Vec sqrt(Vec a) { EXTRAGS_EACH(native_sqrt(a.v[i])); }
EXTRAGS_INLINE Vec abs(Vec a) { EXTRAGS_EACH((NativeFloat)((NativeInt)a.v[i] & 0x7fffffff)); }
EXTRAGS_INLINE Vec load(const float* p) {
  EXTRAGS_EACH(*reinterpret_cast<const UnalignedFloat*>(p + kNative * i));
}
EXTRAGS_INLINE void store(float* p, Vec a) {
  for (int i = 0; i < kParts; ++i) *reinterpret_cast<UnalignedFloat*>(p + kNative * i) = a.v[i];
}
EXTRAGS_INLINE void stream(float* p, Vec a) {
#if defined(__AVX2__) && defined(__FMA__)
  for (int i = 0; i < kParts; ++i) _mm256_stream_ps(p + kNative * i, a.v[i]);
#elif defined(__SSE2__)
  for (int i = 0; i < kParts; ++i) _mm_stream_ps(p + kNative * i, a.v[i]);
#else
  store(p, a);
#endif
}
EXTRAGS_INLINE void finish_streams() {
#if defined(__SSE2__)
  _mm_sfence();
#endif
}
EXTRAGS_INLINE Vec load_first(const float* p, int n) {
  alignas(64) float t[16] = {};
  for (int i = 0; i < n; ++i) t[i] = p[i];
  return load(t);
}
EXTRAGS_INLINE void store_first(float* p, Vec a, int n) {
  alignas(64) float t[16];
  store(t, a);
  for (int i = 0; i < n; ++i) p[i] = t[i];
}
EXTRAGS_INLINE Mask ge(Vec a, Vec b) { EXTRAGS_EACH_MASK(a.v[i] >= b.v[i]); }
EXTRAGS_INLINE Mask gt(Vec a, Vec b) { EXTRAGS_EACH_MASK(a.v[i] > b.v[i]); }
EXTRAGS_INLINE Mask operator&(Mask a, Mask b) { EXTRAGS_EACH_MASK(a.m[i] & b.m[i]); }
EXTRAGS_INLINE Mask without(Mask a, Mask b) { EXTRAGS_EACH_MASK(a.m[i] & ~b.m[i]); }
EXTRAGS_INLINE uint32_t to_bits(Mask a) {
  uint32_t bits = 0;
  for (int i = 0; i < kParts; ++i) bits |= native_bits(a.m[i]) << (kNative * i);
  return bits;
}
EXTRAGS_INLINE Mask from_bits(uint16_t bits) {
  alignas(64) static const int32_t lanes[16] = {1,      1 << 1, 1 << 2,  1 << 3,  1 << 4,  1 << 5,  1 << 6,  1 << 7,
                                                1 << 8, 1 << 9, 1 << 10, 1 << 11, 1 << 12, 1 << 13, 1 << 14, 1 << 15};
  Mask r;
  for (int i = 0; i < kParts; ++i) {
    const NativeInt lane = *reinterpret_cast<const NativeInt*>(lanes + kNative * i);
    r.m[i] = ((NativeInt{} + bits) & lane) == lane;
  }
  return r;
}
EXTRAGS_INLINE bool any(Mask a) {
  NativeInt some = a.m[0];
  for (int i = 1; i < kParts; ++i) some |= a.m[i];
  return native_bits(some) != 0;
}
EXTRAGS_INLINE Vec select(Mask m, Vec a, Vec b) { EXTRAGS_EACH(m.m[i] ? a.v[i] : b.v[i]); }
EXTRAGS_INLINE Vec keep(Mask m, Vec a) { EXTRAGS_EACH((NativeFloat)(m.m[i] & (NativeInt)a.v[i])); }
EXTRAGS_INLINE float sum(Vec a) {
  alignas(64) float t[16];
  store(t, a);
  for (int half = 8; half > 0; half /= 2) {
    for (int i = 0; i < half; ++i) t[i] += t[i + half];
  }
  return t[0];
}
EXTRAGS_INLINE float largest(Vec a) {
  alignas(64) float t[16];
  store(t, a);
  float best = t[0];
  for (int i = 1; i < 16; ++i) best = t[i] > best ? t[i] : best;
  return best;
}
// To nearest even, for |a| < 2^22. Relies on IEEE rounding: never compile with -ffast-math.
EXTRAGS_INLINE Vec round(Vec a) { EXTRAGS_EACH((a.v[i] + 12582912.f) - 12582912.f); }
EXTRAGS_INLINE Vec scale_by_power(Vec a, Vec n) {
  EXTRAGS_EACH((NativeFloat)((NativeInt)a.v[i] + (__builtin_convertvector(n.v[i], NativeInt) << 23)));
}
EXTRAGS_INLINE Vec split_power(Vec x, Vec* mantissa) {
  Vec power;
  for (int i = 0; i < kParts; ++i) {
    const NativeInt bits = (NativeInt)x.v[i], e = (bits - 0x3f400000) >> 23;
    mantissa->v[i] = (NativeFloat)(bits - (e << 23));
    power.v[i] = __builtin_convertvector(e, NativeFloat);
  }
  return power;
}
#if defined(__AVX2__) && defined(__FMA__)
// For each byte, the places of its set bits in front
struct SetBits {
  uint8_t places[256][8];
};
constexpr SetBits set_bits() {
  SetBits table{};
  for (int byte = 0; byte < 256; ++byte) {
    int count = 0;
    for (int bit = 0; bit < 8; ++bit) {
      if ((byte >> bit & 1) != 0) table.places[byte][count++] = static_cast<uint8_t>(bit);
    }
  }
  return table;
}
alignas(64) static constexpr SetBits kSetBits = set_bits();

EXTRAGS_INLINE int append_lanes(uint32_t* p, uint32_t bits, uint32_t base) {
  const uint32_t low = bits & 0xff, high = bits >> 8;
  const __m256i a = _mm256_cvtepu8_epi32(_mm_loadl_epi64(reinterpret_cast<const __m128i*>(kSetBits.places[low])));
  const __m256i b = _mm256_cvtepu8_epi32(_mm_loadl_epi64(reinterpret_cast<const __m128i*>(kSetBits.places[high])));
  const int count = __builtin_popcount(low);
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(p), _mm256_add_epi32(a, _mm256_set1_epi32(static_cast<int>(base))));
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(p + count),
                      _mm256_add_epi32(b, _mm256_set1_epi32(static_cast<int>(base) + 8)));
  return count + __builtin_popcount(high);
}
#else
EXTRAGS_INLINE int append_lanes(uint32_t* p, uint32_t bits, uint32_t base) {
  int count = 0;
  for (; bits != 0; bits &= bits - 1) p[count++] = base + static_cast<uint32_t>(__builtin_ctz(bits));
  return count;
}
#endif
EXTRAGS_INLINE void store_packed(uint32_t* p, Vec low, Vec high) {
  for (int i = 0; i < kParts; ++i) {
    const NativeInt packed = __builtin_convertvector(low.v[i], NativeInt) |
                             __builtin_convertvector(high.v[i], NativeInt) << 16;
    memcpy(p + kNative * i, &packed, sizeof packed);
  }
}
EXTRAGS_INLINE NativeFloat native_shuffle_44(NativeFloat a, NativeFloat b) {
#if defined(__AVX2__) && defined(__FMA__)
  return _mm256_shuffle_ps(a, b, 0x44);
#else
  return __builtin_shufflevector(a, b, 0, 1, 4, 5);
#endif
}
EXTRAGS_INLINE NativeFloat native_shuffle_ee(NativeFloat a, NativeFloat b) {
#if defined(__AVX2__) && defined(__FMA__)
  return _mm256_shuffle_ps(a, b, 0xee);
#else
  return __builtin_shufflevector(a, b, 2, 3, 6, 7);
#endif
}
EXTRAGS_INLINE NativeFloat native_unpack_low(NativeFloat a, NativeFloat b) {
#if defined(__AVX2__) && defined(__FMA__)
  return _mm256_unpacklo_ps(a, b);
#else
  return __builtin_shufflevector(a, b, 0, 4, 1, 5);
#endif
}
EXTRAGS_INLINE NativeFloat native_unpack_high(NativeFloat a, NativeFloat b) {
#if defined(__AVX2__) && defined(__FMA__)
  return _mm256_unpackhi_ps(a, b);
#else
  return __builtin_shufflevector(a, b, 2, 6, 3, 7);
#endif
}
EXTRAGS_INLINE void transpose_in_quads(Vec* r) {
  for (int i = 0; i < kParts; ++i) {
    const NativeFloat a = native_unpack_low(r[0].v[i], r[1].v[i]), b = native_unpack_high(r[0].v[i], r[1].v[i]);
    const NativeFloat c = native_unpack_low(r[2].v[i], r[3].v[i]), d = native_unpack_high(r[2].v[i], r[3].v[i]);
    r[0].v[i] = native_shuffle_44(a, c);
    r[1].v[i] = native_shuffle_ee(a, c);
    r[2].v[i] = native_shuffle_44(b, d);
    r[3].v[i] = native_shuffle_ee(b, d);
  }
}
template <int kPlace>
EXTRAGS_INLINE Vec splat_in_quads(Vec a) {
#if defined(__AVX2__) && defined(__FMA__)
  EXTRAGS_EACH(_mm256_permute_ps(a.v[i], kPlace * 0x55));
#else
  EXTRAGS_EACH(__builtin_shufflevector(a.v[i], a.v[i], kPlace, kPlace, kPlace, kPlace));
#endif
}
EXTRAGS_INLINE Vec sum_quads(Vec a, Vec b, Vec c, Vec d) {
  Vec r;
#if defined(__AVX2__) && defined(__FMA__)
  const __m256 s = a.v[0] + a.v[1], t = b.v[0] + b.v[1], u = c.v[0] + c.v[1], v = d.v[0] + d.v[1];
  r.v[0] = _mm256_permute2f128_ps(s, t, 0x20) + _mm256_permute2f128_ps(s, t, 0x31);
  r.v[1] = _mm256_permute2f128_ps(u, v, 0x20) + _mm256_permute2f128_ps(u, v, 0x31);
#else
  const Vec* in[4] = {&a, &b, &c, &d};
  for (int i = 0; i < 4; ++i) r.v[i] = (in[i]->v[0] + in[i]->v[2]) + (in[i]->v[1] + in[i]->v[3]);
#endif
  return r;
}
template <int kColumns>
EXTRAGS_INLINE void load_interleaved(const float* p, Vec* columns) {
  alignas(64) float t[kColumns][16];
  for (int i = 0; i < 16; ++i) {
    for (int k = 0; k < kColumns; ++k) t[k][i] = p[kColumns * i + k];
  }
  for (int k = 0; k < kColumns; ++k) columns[k] = load(t[k]);
}
template <int kColumns>
EXTRAGS_INLINE void store_interleaved(float* p, const Vec* columns) {
  alignas(64) float t[kColumns][16];
  for (int k = 0; k < kColumns; ++k) store(t[k], columns[k]);
  for (int i = 0; i < 16; ++i) {
    for (int k = 0; k < kColumns; ++k) p[kColumns * i + k] = t[k][i];
  }
}
// Sixteen rows of three or four floats, to and from one vector per column
EXTRAGS_INLINE void load_triples(const float* p, Vec* columns) { load_interleaved<3>(p, columns); }
EXTRAGS_INLINE void store_triples(float* p, const Vec* columns) { store_interleaved<3>(p, columns); }
EXTRAGS_INLINE void load_quads(const float* p, Vec* columns) { load_interleaved<4>(p, columns); }
EXTRAGS_INLINE void store_quads(float* p, const Vec* columns) { store_interleaved<4>(p, columns); }
EXTRAGS_INLINE void transpose16(const float* source, float* target) {
#if defined(__AVX2__) && defined(__FMA__)
  for (int bi = 0; bi < 16; bi += 8) {
    for (int bj = 0; bj < 16; bj += 8) {
      __m256 r[8], t[8];
      for (int i = 0; i < 8; ++i) r[i] = _mm256_loadu_ps(source + 16 * (bi + i) + bj);
      for (int i = 0; i < 8; i += 2) {
        t[i] = _mm256_unpacklo_ps(r[i], r[i + 1]);
        t[i + 1] = _mm256_unpackhi_ps(r[i], r[i + 1]);
      }
      for (int i = 0; i < 8; i += 4) {
        for (int k = 0; k < 2; ++k) {
          r[i + 2 * k] = _mm256_shuffle_ps(t[i + k], t[i + 2 + k], 0x44);
          r[i + 2 * k + 1] = _mm256_shuffle_ps(t[i + k], t[i + 2 + k], 0xee);
        }
      }
      for (int c = 0; c < 4; ++c) {
        float* row = target + 16 * (bj + c) + bi;
        _mm256_storeu_ps(row, _mm256_permute2f128_ps(r[c], r[4 + c], 0x20));
        _mm256_storeu_ps(row + 64, _mm256_permute2f128_ps(r[c], r[4 + c], 0x31));
      }
    }
  }
#else
  for (int bi = 0; bi < 16; bi += 4) {
    for (int bj = 0; bj < 16; bj += 4) {
      NativeFloat r[4];
      for (int i = 0; i < 4; ++i) {
        r[i] = *reinterpret_cast<const UnalignedFloat*>(source + 16 * (bi + i) + bj);
      }
      const NativeFloat a = __builtin_shufflevector(r[0], r[1], 0, 4, 1, 5);
      const NativeFloat b = __builtin_shufflevector(r[0], r[1], 2, 6, 3, 7);
      const NativeFloat c = __builtin_shufflevector(r[2], r[3], 0, 4, 1, 5);
      const NativeFloat d = __builtin_shufflevector(r[2], r[3], 2, 6, 3, 7);
      NativeFloat column[4] = {
          __builtin_shufflevector(a, c, 0, 1, 4, 5), __builtin_shufflevector(a, c, 2, 3, 6, 7),
          __builtin_shufflevector(b, d, 0, 1, 4, 5), __builtin_shufflevector(b, d, 2, 3, 6, 7)};
      for (int k = 0; k < 4; ++k) {
        *reinterpret_cast<UnalignedFloat*>(target + 16 * (bj + k) + bi) = column[k];
      }
    }
  }
#endif
}
#undef EXTRAGS_EACH
#undef EXTRAGS_EACH_MASK
