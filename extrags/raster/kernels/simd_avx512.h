// Vec and Mask as AVX-512 registers; see simd.h.

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
