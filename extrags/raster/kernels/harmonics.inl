// Spherical harmonics: colours of sixteen Gaussians from their coefficients, and the gradient.

template <int kDegree>
EXTRAGS_INLINE void harmonics(const Vec* d, Vec* y) {
  y[0] = Vec(0.28209479177387814f);
  if constexpr (kDegree > 0) {
    const Vec c(0.4886025119029199f);
    y[1] = negated(c * d[1]);
    y[2] = c * d[2];
    y[3] = negated(c * d[0]);
  }
  if constexpr (kDegree > 1) {
    const Vec xx = d[0] * d[0], yy = d[1] * d[1], zz = d[2] * d[2], c(1.0925484305920792f);
    y[4] = c * (d[0] * d[1]);
    y[5] = negated(c * (d[1] * d[2]));
    y[6] = Vec(0.31539156525252005f) * (fma(Vec(2.f), zz, negated(xx)) - yy);
    y[7] = negated(c * (d[0] * d[2]));
    y[8] = Vec(0.5462742152960396f) * (xx - yy);
    if constexpr (kDegree > 2) {
      const Vec ring = fma(Vec(4.f), zz, negated(xx)) - yy;
      y[9] = Vec(-0.5900435899266435f) * d[1] * fma(Vec(3.f), xx, negated(yy));
      y[10] = Vec(2.890611442640554f) * (d[0] * d[1]) * d[2];
      y[11] = Vec(-0.4570457994644658f) * d[1] * ring;
      y[12] = Vec(0.3731763325901154f) * d[2] * fma(Vec(2.f), zz, Vec(-3.f) * (xx + yy));
      y[13] = Vec(-0.4570457994644658f) * d[0] * ring;
      y[14] = Vec(1.445305721320277f) * d[2] * (xx - yy);
      y[15] = Vec(-0.5900435899266435f) * d[0] * fnma(Vec(3.f), yy, xx);
    }
  }
}

// Sum over k of g[k] times the gradient of harmonic k with respect to the direction.
template <int kDegree>
EXTRAGS_INLINE void harmonics_gradient(const Vec* d, const Vec* g, Vec* v) {
  for (int j = 0; j < 3; ++j) v[j] = Vec(0.f);
  const Vec x = d[0], y = d[1], z = d[2];
  if constexpr (kDegree > 0) {
    const Vec c(0.4886025119029199f);
    v[0] = negated(c * g[3]);
    v[1] = negated(c * g[1]);
    v[2] = c * g[2];
  }
  if constexpr (kDegree > 1) {
    const Vec c(1.0925484305920792f), two(2.f);
    const Vec axial = Vec(0.31539156525252005f) * g[6];
    v[0] = v[0] + c * (y * g[4] - z * g[7] + x * g[8]) - two * axial * x;
    v[1] = v[1] + c * (x * g[4] - z * g[5] - y * g[8]) - two * axial * y;
    v[2] = v[2] - c * (y * g[5] + x * g[7]) + Vec(4.f) * axial * z;
  }
  if constexpr (kDegree > 2) {
    const Vec xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
    const Vec a = Vec(-0.5900435899266435f) * g[9], b = Vec(2.890611442640554f) * g[10];
    const Vec c = Vec(-0.4570457994644658f) * g[11], e = Vec(0.3731763325901154f) * g[12];
    const Vec f = Vec(-0.4570457994644658f) * g[13], h = Vec(1.445305721320277f) * g[14];
    const Vec l = Vec(-0.5900435899266435f) * g[15];
    const Vec two(2.f), three(3.f), four(4.f), six(6.f), eight(8.f);
    v[0] = v[0] + six * a * xy + b * yz - two * c * xy - six * e * xz +
           f * (four * zz - three * xx - yy) + two * h * xz + three * l * (xx - yy);
    v[1] = v[1] + three * a * (xx - yy) + b * xz + c * (four * zz - xx - three * yy) -
           six * e * yz - two * f * xy - two * h * yz - six * l * xy;
    v[2] = v[2] + b * xy + eight * c * yz + e * (six * zz - three * (xx + yy)) +
           eight * f * xz + h * (xx - yy);
  }
}

// Harmonic coefficients of sixteen Gaussians, one vector per float of a row: out[3 k + channel].
template <int kFloats>
EXTRAGS_INLINE void load_coefficients(const Scene* scene, int first, int rows, float* out) {
  const size_t stride = 3 * static_cast<size_t>(scene->coefficients);
  const float* source = scene->sh + stride * first;
  alignas(64) float t[256];
  for (int start = 0; start < kFloats; start += 16) {
    const int width = kFloats - start < 16 ? kFloats - start : 16;
    for (int i = 0; i < 16; ++i) {
      const float* row = source + stride * i + start;
      store(t + 16 * i, i >= rows ? Vec(0.f) : width == 16 ? load(row) : load_first(row, width));
    }
    transpose16(t, out + 16 * start);
  }
}

// Fetches the coefficients of up to sixteen Gaussians ahead of their use: rows are read a third at a time, a
// pattern that the processor does not foresee.
EXTRAGS_INLINE void prefetch_coefficients(const Scene* scene, int first, int end) {
  if (scene->sh == nullptr) return;
  const size_t stride = 3 * static_cast<size_t>(scene->coefficients);
  const int rows = end - first < 16 ? end - first : 16;
  const float* source = scene->sh + stride * first;
  for (size_t at = 0; rows > 0 && at < stride * rows; at += 16) __builtin_prefetch(source + at);
}

// The colours of sixteen Gaussians; leaves their coefficients, [48][16], for `shade_backward`.
template <int kDegree>
EXTRAGS_INLINE void shade(const Scene* scene, int first, int rows, const Projected& p, float* coefficients,
                          Vec* color) {
  constexpr int kCount = (kDegree + 1) * (kDegree + 1);
  Vec y[16];
  load_coefficients<3 * kCount>(scene, first, rows, coefficients);
  harmonics<kDegree>(p.direction, y);
  for (int channel = 0; channel < 3; ++channel) {
    Vec value(0.5f);
    for (int k = 0; k < kCount; ++k) {
      value = fma(y[k], load(coefficients + 16 * (3 * k + channel)), value);
    }
    color[channel] = max(value, Vec(0.f));
  }
}

// Gradient of the harmonics: writes that of the coefficients, returns that of the direction. `t` holds what
// `shade` left and is used up.
template <int kDegree>
EXTRAGS_INLINE void shade_backward(const Scene* scene, const SceneGradients* out, int first, int rows,
                                   const Projected& p, float* t, const Vec* v_color, Vec* v_direction) {
  constexpr int kCount = (kDegree + 1) * (kDegree + 1), kFloats = 3 * kCount;
  const size_t stride = 3 * static_cast<size_t>(scene->coefficients);
  Vec y[16];
  if constexpr (kDegree > 0) {
    Vec g[16];
    for (int k = 1; k < kCount; ++k) {
      g[k] = fma(v_color[0], load(t + 48 * k),
                 fma(v_color[1], load(t + 48 * k + 16), v_color[2] * load(t + 48 * k + 32)));
    }
    harmonics_gradient<kDegree>(p.direction, g, v_direction);
  } else {
    for (int j = 0; j < 3; ++j) v_direction[j] = Vec(0.f);
  }
  if (out->sh == nullptr) return;
  harmonics<kDegree>(p.direction, y);
  for (int k = 0; k < kCount; ++k) {
    for (int channel = 0; channel < 3; ++channel) {
      store(t + 16 * (3 * k + channel), y[k] * v_color[channel]);
    }
  }
  alignas(64) float back[256];
  float* target = out->sh + stride * first;
  // Past the caches, where rows are whole lines: they are the most of what is written, and next read by Adam, after
  // all others.
  const bool streamed = kDegree == 3 && stride == 48 && !out->add && reinterpret_cast<uintptr_t>(target) % 64 == 0;
  for (int start = 0; start < kFloats; start += 16) {
    const int width = kFloats - start < 16 ? kFloats - start : 16;
    if (width < 16) memset(t + 16 * (start + width), 0, sizeof(float) * 16 * (16 - width));
    transpose16(t + 16 * start, back);
    for (int i = 0; i < rows; ++i) {
      float* row = target + stride * i + start;
      Vec value = load(back + 16 * i);
      if (out->add) value = value + load_first(row, width);
      if (width == 16) {
        if (streamed) {
          stream(row, value);
        } else {
          store(row, value);
        }
      } else {
        store_first(row, value, width);
      }
    }
  }
  // Coefficients above the degree in use
  if (!out->add && kCount < scene->coefficients) {
    for (int i = 0; i < rows; ++i) {
      memset(target + stride * i + kFloats, 0, sizeof(float) * (stride - kFloats));
    }
  }
}
