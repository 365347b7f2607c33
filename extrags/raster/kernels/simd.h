// Sixteen floats at a time: one AVX-512 register, two of AVX2, four of SSE2 or NEON.
//
// AVX-512, AVX2 and NEON give the same bits: each operation is one correctly rounded IEEE operation, fused
// multiply-adds are written out (the compiler must not contract others), sums are taken in the same order.
// The SSE2 build has no fused multiply-add and differs by rounding.
//
// Included once per instruction set, inside a namespace of its own.

#define EXTRAGS_INLINE static inline __attribute__((always_inline))

constexpr float kLog2E = 1.4426950408889634f;
constexpr float kLn2 = 0.6931471805599453f;

#if defined(__AVX512F__) && defined(__AVX512DQ__) && defined(__AVX512VL__)

struct Mask {
  __mmask16 bits;
};
struct Vec {
  __m512 v;
  Vec() = default;
  Vec(__m512 value) : v(value) {}
  Vec(float value) : v(_mm512_set1_ps(value)) {}
};

EXTRAGS_INLINE Vec operator+(Vec a, Vec b) { return _mm512_add_ps(a.v, b.v); }
EXTRAGS_INLINE Vec operator-(Vec a, Vec b) { return _mm512_sub_ps(a.v, b.v); }
EXTRAGS_INLINE Vec operator*(Vec a, Vec b) { return _mm512_mul_ps(a.v, b.v); }
EXTRAGS_INLINE Vec operator/(Vec a, Vec b) { return _mm512_div_ps(a.v, b.v); }
EXTRAGS_INLINE Vec fma(Vec a, Vec b, Vec c) { return _mm512_fmadd_ps(a.v, b.v, c.v); }
EXTRAGS_INLINE Vec fnma(Vec a, Vec b, Vec c) { return _mm512_fnmadd_ps(a.v, b.v, c.v); }
EXTRAGS_INLINE Vec min(Vec a, Vec b) { return _mm512_min_ps(a.v, b.v); }
EXTRAGS_INLINE Vec max(Vec a, Vec b) { return _mm512_max_ps(a.v, b.v); }
EXTRAGS_INLINE Vec sqrt(Vec a) { return _mm512_sqrt_ps(a.v); }
EXTRAGS_INLINE Vec abs(Vec a) { return _mm512_abs_ps(a.v); }
EXTRAGS_INLINE Vec load(const float* p) { return _mm512_loadu_ps(p); }
EXTRAGS_INLINE void store(float* p, Vec a) { _mm512_storeu_ps(p, a.v); }
// A whole cache line, 64-byte aligned, past the caches; seen by other threads after `finish_streams`
EXTRAGS_INLINE void stream(float* p, Vec a) { _mm512_stream_ps(p, a.v); }
EXTRAGS_INLINE void finish_streams() { _mm_sfence(); }
EXTRAGS_INLINE Vec load_first(const float* p, int n) {
  return _mm512_maskz_loadu_ps(static_cast<__mmask16>((1u << n) - 1), p);
}
EXTRAGS_INLINE void store_first(float* p, Vec a, int n) {
  _mm512_mask_storeu_ps(p, static_cast<__mmask16>((1u << n) - 1), a.v);
}
EXTRAGS_INLINE Mask ge(Vec a, Vec b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GE_OQ)}; }
EXTRAGS_INLINE Mask gt(Vec a, Vec b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GT_OQ)}; }
EXTRAGS_INLINE Mask operator&(Mask a, Mask b) { return {static_cast<__mmask16>(a.bits & b.bits)}; }
EXTRAGS_INLINE Mask without(Mask a, Mask b) { return {static_cast<__mmask16>(a.bits & ~b.bits)}; }
EXTRAGS_INLINE bool any(Mask a) { return a.bits != 0; }
EXTRAGS_INLINE uint32_t to_bits(Mask a) { return a.bits; }
EXTRAGS_INLINE Mask from_bits(uint16_t bits) { return {bits}; }
EXTRAGS_INLINE Vec select(Mask m, Vec a, Vec b) { return _mm512_mask_blend_ps(m.bits, b.v, a.v); }
EXTRAGS_INLINE Vec keep(Mask m, Vec a) { return _mm512_maskz_mov_ps(m.bits, a.v); }
EXTRAGS_INLINE float sum(Vec a) {
  const __m256 h = _mm256_add_ps(_mm512_castps512_ps256(a.v), _mm512_extractf32x8_ps(a.v, 1));
  const __m128 q = _mm_add_ps(_mm256_castps256_ps128(h), _mm256_extractf128_ps(h, 1));
  const __m128 d = _mm_add_ps(q, _mm_movehl_ps(q, q));
  return _mm_cvtss_f32(_mm_add_ss(d, _mm_shuffle_ps(d, d, 1)));
}
EXTRAGS_INLINE float largest(Vec a) { return _mm512_reduce_max_ps(a.v); }
EXTRAGS_INLINE Vec round(Vec a) {
  return _mm512_roundscale_ps(a.v, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
}
// a * 2^n for integral n with a normal result
EXTRAGS_INLINE Vec scale_by_power(Vec a, Vec n) { return _mm512_scalef_ps(a.v, n.v); }
// x = mantissa * 2^result with the mantissa in [0.75, 1.5), for normal positive x
EXTRAGS_INLINE Vec split_power(Vec x, Vec* mantissa) {
  const __m512i q = _mm512_sub_epi32(_mm512_castps_si512(x.v), _mm512_set1_epi32(0x3f400000));
  const __m512i e = _mm512_srai_epi32(q, 23);
  mantissa->v = _mm512_castsi512_ps(
      _mm512_sub_epi32(_mm512_castps_si512(x.v), _mm512_slli_epi32(e, 23)));
  return _mm512_cvtepi32_ps(e);
}
// Writes base + lane for the set bits, in order, and returns how many. May write all 16 places.
EXTRAGS_INLINE int append_lanes(uint32_t* p, uint32_t bits, uint32_t base) {
  const __m512i lanes = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
  const __m512i values = _mm512_add_epi32(lanes, _mm512_set1_epi32(static_cast<int>(base)));
  _mm512_storeu_si512(p, _mm512_maskz_compress_epi32(static_cast<__mmask16>(bits), values));
  return __builtin_popcount(bits);
}
// low | high << 16 of the truncated values
EXTRAGS_INLINE void store_packed(uint32_t* p, Vec low, Vec high) {
  const __m512i a = _mm512_cvttps_epi32(low.v), b = _mm512_cvttps_epi32(high.v);
  _mm512_storeu_si512(p, _mm512_or_si512(a, _mm512_slli_epi32(b, 16)));
}
// Lanes as four quads: quad j of vector i and place i of quad j change places.
EXTRAGS_INLINE void transpose_in_quads(Vec* r) {
  const __m512 a = _mm512_unpacklo_ps(r[0].v, r[1].v), b = _mm512_unpackhi_ps(r[0].v, r[1].v);
  const __m512 c = _mm512_unpacklo_ps(r[2].v, r[3].v), d = _mm512_unpackhi_ps(r[2].v, r[3].v);
  r[0].v = _mm512_shuffle_ps(a, c, 0x44);
  r[1].v = _mm512_shuffle_ps(a, c, 0xee);
  r[2].v = _mm512_shuffle_ps(b, d, 0x44);
  r[3].v = _mm512_shuffle_ps(b, d, 0xee);
}
// Each quad filled with its own place kPlace
template <int kPlace>
EXTRAGS_INLINE Vec splat_in_quads(Vec a) {
  return _mm512_permute_ps(a.v, kPlace * 0x55);
}
// The sums over the quads of a, b, c and d, as quads 0 to 3: (0 + 2) + (1 + 3)
EXTRAGS_INLINE Vec sum_quads(Vec a, Vec b, Vec c, Vec d) {
  const __m512 s = _mm512_add_ps(_mm512_shuffle_f32x4(a.v, b.v, 0x44), _mm512_shuffle_f32x4(a.v, b.v, 0xee));
  const __m512 t = _mm512_add_ps(_mm512_shuffle_f32x4(c.v, d.v, 0x44), _mm512_shuffle_f32x4(c.v, d.v, 0xee));
  return _mm512_add_ps(_mm512_shuffle_f32x4(s, t, 0x88), _mm512_shuffle_f32x4(s, t, 0xdd));
}
// Sixteen rows of three or four floats, to and from one vector per column
EXTRAGS_INLINE void load_triples(const float* p, Vec* columns) {
  const __m512 a = _mm512_loadu_ps(p), b = _mm512_loadu_ps(p + 16), c = _mm512_loadu_ps(p + 32);
  // Float 3 i + k lies in a for the first places, then in b (16 and up), then in c.
  const __m512i x1 = _mm512_setr_epi32(0, 3, 6, 9, 12, 15, 18, 21, 24, 27, 30, 0, 0, 0, 0, 0);
  const __m512i x2 = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 17, 20, 23, 26, 29);
  const __m512i y1 = _mm512_setr_epi32(1, 4, 7, 10, 13, 16, 19, 22, 25, 28, 31, 0, 0, 0, 0, 0);
  const __m512i y2 = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 18, 21, 24, 27, 30);
  const __m512i z1 = _mm512_setr_epi32(2, 5, 8, 11, 14, 17, 20, 23, 26, 29, 0, 0, 0, 0, 0, 0);
  const __m512i z2 = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 16, 19, 22, 25, 28, 31);
  columns[0] = _mm512_permutex2var_ps(_mm512_permutex2var_ps(a, x1, b), x2, c);
  columns[1] = _mm512_permutex2var_ps(_mm512_permutex2var_ps(a, y1, b), y2, c);
  columns[2] = _mm512_permutex2var_ps(_mm512_permutex2var_ps(a, z1, b), z2, c);
}
EXTRAGS_INLINE void store_triples(float* p, const Vec* columns) {
  const __m512 x = columns[0].v, y = columns[1].v, z = columns[2].v;
  const __m512i a1 = _mm512_setr_epi32(0, 16, 0, 1, 17, 0, 2, 18, 0, 3, 19, 0, 4, 20, 0, 5);
  const __m512i a2 = _mm512_setr_epi32(0, 1, 16, 3, 4, 17, 6, 7, 18, 9, 10, 19, 12, 13, 20, 15);
  const __m512i b1 = _mm512_setr_epi32(21, 0, 6, 22, 0, 7, 23, 0, 8, 24, 0, 9, 25, 0, 10, 26);
  const __m512i b2 = _mm512_setr_epi32(0, 21, 2, 3, 22, 5, 6, 23, 8, 9, 24, 11, 12, 25, 14, 15);
  const __m512i c1 = _mm512_setr_epi32(0, 11, 27, 0, 12, 28, 0, 13, 29, 0, 14, 30, 0, 15, 31, 0);
  const __m512i c2 = _mm512_setr_epi32(26, 1, 2, 27, 4, 5, 28, 7, 8, 29, 10, 11, 30, 13, 14, 31);
  _mm512_storeu_ps(p, _mm512_permutex2var_ps(_mm512_permutex2var_ps(x, a1, y), a2, z));
  _mm512_storeu_ps(p + 16, _mm512_permutex2var_ps(_mm512_permutex2var_ps(x, b1, y), b2, z));
  _mm512_storeu_ps(p + 32, _mm512_permutex2var_ps(_mm512_permutex2var_ps(x, c1, y), c2, z));
}
EXTRAGS_INLINE void load_quads(const float* p, Vec* columns) {
  const __m512 a = _mm512_loadu_ps(p), b = _mm512_loadu_ps(p + 16);
  const __m512 c = _mm512_loadu_ps(p + 32), d = _mm512_loadu_ps(p + 48);
  const __m512i even = _mm512_setr_epi32(0, 4, 8, 12, 16, 20, 24, 28, 1, 5, 9, 13, 17, 21, 25, 29);
  const __m512i odd = _mm512_add_epi32(even, _mm512_set1_epi32(2));
  const __m512 t0 = _mm512_permutex2var_ps(a, even, b), t1 = _mm512_permutex2var_ps(c, even, d);
  const __m512 t2 = _mm512_permutex2var_ps(a, odd, b), t3 = _mm512_permutex2var_ps(c, odd, d);
  columns[0] = _mm512_shuffle_f32x4(t0, t1, 0x44);
  columns[1] = _mm512_shuffle_f32x4(t0, t1, 0xee);
  columns[2] = _mm512_shuffle_f32x4(t2, t3, 0x44);
  columns[3] = _mm512_shuffle_f32x4(t2, t3, 0xee);
}
EXTRAGS_INLINE void store_quads(float* p, const Vec* columns) {
  const __m512i even = _mm512_setr_epi32(0, 8, 16, 24, 1, 9, 17, 25, 2, 10, 18, 26, 3, 11, 19, 27);
  const __m512i odd = _mm512_add_epi32(even, _mm512_set1_epi32(4));
  const __m512 t0 = _mm512_shuffle_f32x4(columns[0].v, columns[1].v, 0x44);
  const __m512 t1 = _mm512_shuffle_f32x4(columns[2].v, columns[3].v, 0x44);
  const __m512 t2 = _mm512_shuffle_f32x4(columns[0].v, columns[1].v, 0xee);
  const __m512 t3 = _mm512_shuffle_f32x4(columns[2].v, columns[3].v, 0xee);
  _mm512_storeu_ps(p, _mm512_permutex2var_ps(t0, even, t1));
  _mm512_storeu_ps(p + 16, _mm512_permutex2var_ps(t0, odd, t1));
  _mm512_storeu_ps(p + 32, _mm512_permutex2var_ps(t2, even, t3));
  _mm512_storeu_ps(p + 48, _mm512_permutex2var_ps(t2, odd, t3));
}
EXTRAGS_INLINE void transpose16(const float* source, float* target) {
  __m512 r[16], t[16];
  for (int i = 0; i < 16; ++i) r[i] = _mm512_loadu_ps(source + 16 * i);
  for (int i = 0; i < 16; i += 2) {
    t[i] = _mm512_unpacklo_ps(r[i], r[i + 1]);
    t[i + 1] = _mm512_unpackhi_ps(r[i], r[i + 1]);
  }
  for (int i = 0; i < 16; i += 4) {
    for (int k = 0; k < 2; ++k) {
      const __m512d a = _mm512_castps_pd(t[i + k]), b = _mm512_castps_pd(t[i + 2 + k]);
      r[i + 2 * k] = _mm512_castpd_ps(_mm512_unpacklo_pd(a, b));
      r[i + 2 * k + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(a, b));
    }
  }
  // r[4 g + c] holds, per quarter q, column 4 q + c of rows 4 g .. 4 g + 3
  for (int c = 0; c < 4; ++c) {
    const __m512 a = _mm512_shuffle_f32x4(r[c], r[4 + c], 0x44);
    const __m512 b = _mm512_shuffle_f32x4(r[c], r[4 + c], 0xee);
    const __m512 d = _mm512_shuffle_f32x4(r[8 + c], r[12 + c], 0x44);
    const __m512 e = _mm512_shuffle_f32x4(r[8 + c], r[12 + c], 0xee);
    _mm512_storeu_ps(target + 16 * c, _mm512_shuffle_f32x4(a, d, 0x88));
    _mm512_storeu_ps(target + 16 * (4 + c), _mm512_shuffle_f32x4(a, d, 0xdd));
    _mm512_storeu_ps(target + 16 * (8 + c), _mm512_shuffle_f32x4(b, e, 0x88));
    _mm512_storeu_ps(target + 16 * (12 + c), _mm512_shuffle_f32x4(b, e, 0xdd));
  }
}

#else

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

#endif

EXTRAGS_INLINE Vec negated(Vec a) { return Vec(0.f) - a; }
EXTRAGS_INLINE Vec ramp() {
  alignas(64) static const float lanes[16] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
  return load(lanes);
}
// Lanes below n
EXTRAGS_INLINE Mask first_lanes(int n) { return gt(Vec(static_cast<float>(n)), ramp()); }

// 2^p for |p| < 120, relative error below 2e-7: a degree-5 minimax polynomial on [-1/2, 1/2].
EXTRAGS_INLINE Vec exp2(Vec p) {
  const Vec n = round(p), f = p - n;
  Vec r(1.3276471e-3f);
  r = fma(r, f, Vec(9.6755410e-3f));
  r = fma(r, f, Vec(5.5507131e-2f));
  r = fma(r, f, Vec(2.4022120e-1f));
  r = fma(r, f, Vec(6.9314694e-1f));
  r = fma(r, f, Vec(1.0000001f));
  return scale_by_power(r, n);
}
// log2(x) for normal positive x: the series of 2 atanh((m - 1) / (m + 1)), |argument| <= 1/5.
EXTRAGS_INLINE Vec log2(Vec x) {
  Vec m;
  const Vec power = split_power(x, &m);
  const Vec s = (m - Vec(1.f)) / (m + Vec(1.f)), s2 = s * s;
  Vec r = fma(s2, Vec(1.f / 11), Vec(1.f / 9));
  r = fma(r, s2, Vec(1.f / 7));
  r = fma(r, s2, Vec(1.f / 5));
  r = fma(r, s2, Vec(1.f / 3));
  r = fma(r, s2, Vec(1.f));
  return fma(s * r, Vec(2 * kLog2E), power);
}

// The same for up to sixteen rows of 2, 3 or 4 floats; missing rows are zero.
template <int kColumns>
EXTRAGS_INLINE void load_rows(const float* p, int rows, Vec* columns) {
  if constexpr (kColumns == 3) {
    if (rows == 16) return load_triples(p, columns);
  }
  if constexpr (kColumns == 4) {
    if (rows == 16) return load_quads(p, columns);
  }
  alignas(64) float t[kColumns][16] = {};
  for (int i = 0; i < rows; ++i) {
    for (int k = 0; k < kColumns; ++k) t[k][i] = p[kColumns * i + k];
  }
  for (int k = 0; k < kColumns; ++k) columns[k] = load(t[k]);
}
template <int kColumns>
EXTRAGS_INLINE void store_rows(float* p, int rows, const Vec* columns, bool add) {
  if constexpr (kColumns == 3) {
    if (rows == 16 && !add) return store_triples(p, columns);
  }
  if constexpr (kColumns == 4) {
    if (rows == 16 && !add) return store_quads(p, columns);
  }
  alignas(64) float t[kColumns][16];
  for (int k = 0; k < kColumns; ++k) store(t[k], columns[k]);
  for (int i = 0; i < rows; ++i) {
    for (int k = 0; k < kColumns; ++k) {
      float& to = p[kColumns * i + k];
      to = add ? to + t[k][i] : t[k][i];
    }
  }
}
