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
#include "simd_avx512.h"
#else
#include "simd_registers.h"
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
