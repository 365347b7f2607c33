// The gradient of the projection, sixteen Gaussians at a time.

// A gradient too large for float32 is dropped.
EXTRAGS_INLINE Vec finite(Vec v) { return keep(ge(Vec(3e38f), abs(v)), v); }

// Sums the rows of a Gaussian's tiles, in the order of the tiles.
EXTRAGS_INLINE Vec pair_sum(const float* rows, uint32_t begin, uint32_t end) {
  Vec total = load(rows + 16 * static_cast<size_t>(begin));
  for (uint32_t pair = begin + 1; pair < end; ++pair) {
    total = total + load(rows + 16 * static_cast<size_t>(pair));
  }
  return total;
}

EXTRAGS_INLINE void zero_rows(float* p, int columns, int first, int rows) {
  if (p != nullptr) {
    memset(p + static_cast<size_t>(columns) * first, 0, sizeof(float) * columns * rows);
  }
}

EXTRAGS_INLINE void zero_gradients(const Scene* scene, const SceneGradients* out, int first, int rows) {
  zero_rows(out->means2d, 2, first, rows);
  zero_rows(out->absolute2d, 2, first, rows);
  zero_rows(out->colors, 3, first, rows);
  if (out->add) return;
  zero_rows(out->means, 3, first, rows);
  zero_rows(out->quats, 4, first, rows);
  zero_rows(out->scales, 3, first, rows);
  zero_rows(out->opacities, 1, first, rows);
  zero_rows(out->sh, 3 * scene->coefficients, first, rows);
}

// The inverse of the 2D covariance 0.3 + sum of h h^T, times a vector, through its adjugate
// 0.3 + sum of h' h'^T with h' = (-h_y, h_x): no entry is a difference of large ones.
EXTRAGS_INLINE void apply_conic(const Projected& p, Vec inverse, Vec x, Vec y, Vec* out_x, Vec* out_y) {
  Vec a = Vec(kDilation) * x, b = Vec(kDilation) * y;
  for (int k = 0; k < 3; ++k) {
    const Vec across = fnma(p.half[3 + k], x, p.half[k] * y);
    a = fnma(across, p.half[3 + k], a);
    b = fma(across, p.half[k], b);
  }
  *out_x = a * inverse;
  *out_y = b * inverse;
}

// Carries gradients from the image plane to the parameters of one chunk of Gaussians.
template <int kDegree, bool kColors, bool kPose, bool kLens>
static void project_chunk_backward(View* view, const Scene* scene, const SceneGradients* out, int chunk) {
  const TileRect* rects = static_cast<const TileRect*>(view->rects.data);
  const uint32_t* starts = static_cast<const uint32_t*>(view->pair_starts.data);
  const float* pair_rows = static_cast<const float*>(view->pair_rows.data);
  const Camera& camera = view->camera;
  const float* r = camera.rotation;
  const int begin = chunk * view->chunk;
  const int end = begin + view->chunk < scene->n ? begin + view->chunk : scene->n;
  const Vec zero(0.f), two(2.f);
  Vec pose[15], v_light[kLightLearned];
  for (int k = 0; k < 15; ++k) pose[k] = zero;
  for (int k = 0; k < kLightLearned; ++k) v_light[k] = zero;
  for (int first = begin; first < end; first += 16) {
    const int rows = rows_of(end, first);
    if constexpr (!kColors) prefetch_coefficients(scene, first + 16, end);
    alignas(64) float gathered[256], columns[256];
    uint32_t seen = 0;
    for (int i = 0; i < 16; ++i) {
      Vec total(0.f);
      if (i < rows && rects[first + i].x1 >= rects[first + i].x0) {
        seen |= 1u << i;
        total = pair_sum(pair_rows, starts[first + i], starts[first + i + 1]);
      }
      store(gathered + 16 * i, total);
    }
    if (seen == 0) {
      zero_gradients(scene, out, first, rows);
      continue;
    }
    alignas(64) float flags[16];
    for (int i = 0; i < 16; ++i) flags[i] = static_cast<float>(seen >> i & 1);
    transpose16(gathered, columns);
    Projected p;
    project<kLens>(view, scene, first, rows, p);
    const Mask ok = gt(load(flags), zero);
    // Moments of the gradient g of half the squared Mahalanobis distance: sums of g, g dx, g dy, ...
    const Vec s0 = load(columns), sx = load(columns + 16), sy = load(columns + 32);
    const Vec sxx = load(columns + 48), sxy = load(columns + 64), syy = load(columns + 80);
    const Vec inverse = Vec(1.f) / p.determinant;
    Vec v_u, v_v;
    apply_conic(p, inverse, sx, sy, &v_u, &v_v);
    v_u = finite(keep(ok, v_u));
    v_v = finite(keep(ok, v_v));
    // The gradient of the covariance is -conic S conic / 2 with S the second moments, that of a column h of
    // `half` -conic (S (conic h)): taken so, a needle's long axis does not drown in its short one's rounding.
    Vec v_axes[9], v_j00 = zero, v_j02 = zero, v_j11 = zero, v_j12 = zero;
    [[maybe_unused]] Vec v_j01 = zero, v_j10 = zero;
    for (int j = 0; j < 3; ++j) {
      Vec q_x, q_y, v_a, v_b;
      apply_conic(p, inverse, p.half[j], p.half[3 + j], &q_x, &q_y);
      apply_conic(p, inverse, fma(sxx, q_x, sxy * q_y), fma(sxy, q_x, syy * q_y), &v_a, &v_b);
      v_a = keep(ok, negated(v_a));
      v_b = keep(ok, negated(v_b));
      v_axes[j] = p.j00 * v_a;
      v_axes[3 + j] = p.j11 * v_b;
      if constexpr (kLens) {
        v_axes[j] = fma(p.j10, v_b, v_axes[j]);
        v_axes[3 + j] = fma(p.j01, v_a, v_axes[3 + j]);
        v_j01 = fma(v_a, p.axes[3 + j], v_j01);
        v_j10 = fma(v_b, p.axes[j], v_j10);
      }
      v_axes[6 + j] = fma(p.j02, v_a, p.j12 * v_b);
      v_j00 = fma(v_a, p.axes[j], v_j00);
      v_j02 = fma(v_a, p.axes[6 + j], v_j02);
      v_j11 = fma(v_b, p.axes[3 + j], v_j11);
      v_j12 = fma(v_b, p.axes[6 + j], v_j12);
    }
    // Position in the camera frame, through the centre and through the Jacobian
    // Products are ordered so that neither a near nor a very far Gaussian overflows on the way.
    const Vec iz = p.inverse_z;
    Vec v_point[3];
    if constexpr (kLens) {
      // The Jacobian is (a b; b' c)(1 0 -x; 0 1 -y) / z with the slopes x and y; a, b, c depend on these.
      const Vec x = p.raw_x, y = p.raw_y;
      const Vec fx = Vec(camera.fx) * iz, fy = Vec(camera.fy) * iz;
      const Vec s00 = fx * fnma(x, v_j02, v_j00), s01 = fx * fnma(y, v_j02, v_j01);
      const Vec s10 = fy * fnma(x, v_j12, v_j10), s11 = fy * fnma(y, v_j12, v_j11);
      const Vec once = two * p.gain.first, twice = two * two * p.gain.second;
      const Vec cross = s01 + s10, both = s00 + s11;
      // d(a) = once (x' + 2 x dx) + twice x^2 (x dx + y dy), d(b) = once (x dy + y dx) + twice x y (...)
      const Vec along = twice * fma(x * x, s00, fma(x * y, cross, y * y * s11));
      const Vec v_x = fma(x, along, once * fma(x, both + two * s00, y * cross));
      const Vec v_y = fma(y, along, once * fma(y, both + two * s11, x * cross));
      v_point[0] = fma(p.j00, v_u, p.j10 * v_v) + iz * (v_x - fma(p.j00, v_j02, p.j10 * v_j12));
      v_point[1] = fma(p.j01, v_u, p.j11 * v_v) + iz * (v_y - fma(p.j01, v_j02, p.j11 * v_j12));
      v_point[2] = keep(ok, load(columns + 144)) - fma(x, v_point[0], y * v_point[1]) -
                   iz * (fma(p.j00, v_j00, fma(p.j01, v_j01, p.j02 * v_j02)) +
                         fma(p.j10, v_j10, fma(p.j11, v_j11, p.j12 * v_j12)));
    } else {
      const Vec turn_x = p.j00 * (iz * v_j02), turn_y = p.j11 * (iz * v_j12);
      const Vec bend_x = p.slope_x * turn_x, bend_y = p.slope_y * turn_y;
      v_point[0] = p.j00 * v_u - keep(p.free_x, turn_x);
      v_point[1] = p.j11 * v_v - keep(p.free_y, turn_y);
      v_point[2] = keep(ok, load(columns + 144)) - fma(p.raw_x, p.j00 * v_u, p.raw_y * (p.j11 * v_v)) -
                   iz * fma(p.j00, v_j00, p.j11 * v_j11) + bend_x + keep(p.free_x, bend_x) + bend_y +
                   keep(p.free_y, bend_y);
    }
    Vec v_color[3], v_normal[3] = {zero, zero, zero};
    for (int channel = 0; channel < 3; ++channel) v_color[channel] = finite(load(columns + 96 + 16 * channel));
    Vec albedo[3];
    alignas(64) float coefficients[48 * 16];
    if constexpr (!kColors) shade<kDegree>(scene, first, rows, p, coefficients, albedo);
    Lit lit;
    if (view->lit) {
      if constexpr (kColors) load_rows<3>(scene->colors + 3 * static_cast<size_t>(first), rows, albedo);
      illuminate(view, p, lit);
      for (int channel = 0; channel < 3; ++channel) v_color[channel] = keep(ok, v_color[channel]);
      illuminate_backward(view, lit, albedo, v_color, v_point, v_normal, v_light);
    }
    Vec v_mean[3];
    for (int j = 0; j < 3; ++j) {
      v_mean[j] = fma(Vec(r[j]), v_point[0], fma(Vec(r[3 + j]), v_point[1], Vec(r[6 + j]) * v_point[2]));
    }
    // axes = camera rotation * rotation * scale
    Vec v_rotation[9], v_scale[3];
    for (int j = 0; j < 3; ++j) {
      v_scale[j] = zero;
      for (int i = 0; i < 3; ++i) {
        const Vec v = fma(Vec(r[i]), v_axes[j],
                          fma(Vec(r[3 + i]), v_axes[3 + j], Vec(r[6 + i]) * v_axes[6 + j]));
        v_scale[j] = fma(v, p.rotation[3 * i + j], v_scale[j]);
        v_rotation[3 * i + j] = v * p.scale[j];
      }
    }
    if (view->lit) {
      for (int i = 0; i < 3; ++i) {
        const Vec v = fma(Vec(r[i]), v_normal[0],
                          fma(Vec(r[3 + i]), v_normal[1], Vec(r[6 + i]) * v_normal[2]));
        for (int j = 0; j < 3; ++j) {
          v_rotation[3 * i + j] = v_rotation[3 * i + j] + keep(lit.shortest[j], v);
        }
      }
    }
    const Vec *q = p.quat, *vr = v_rotation;
    Vec v_quat[4];
    v_quat[0] = two * (q[1] * (vr[7] - vr[5]) + q[2] * (vr[2] - vr[6]) + q[3] * (vr[3] - vr[1]));
    v_quat[1] = two * (q[2] * (vr[1] + vr[3]) + q[3] * (vr[2] + vr[6]) + q[0] * (vr[7] - vr[5]) -
                       two * q[1] * (vr[4] + vr[8]));
    v_quat[2] = two * (q[1] * (vr[1] + vr[3]) + q[3] * (vr[5] + vr[7]) + q[0] * (vr[2] - vr[6]) -
                       two * q[2] * (vr[0] + vr[8]));
    v_quat[3] = two * (q[1] * (vr[2] + vr[6]) + q[2] * (vr[5] + vr[7]) + q[0] * (vr[3] - vr[1]) -
                       two * q[3] * (vr[0] + vr[4]));
    const Vec radial = keep(p.unit, fma(v_quat[0], q[0], fma(v_quat[1], q[1],
                                        fma(v_quat[2], q[2], v_quat[3] * q[3]))));
    for (int k = 0; k < 4; ++k) v_quat[k] = finite(keep(ok, fnma(radial, q[k], v_quat[k]) * p.inverse_norm));
    for (int k = 0; k < 3; ++k) v_scale[k] = finite(keep(ok, v_scale[k]));
    Vec v_direction[3] = {zero, zero, zero};
    if constexpr (!kColors) {
      // No gradient where the colour was held at zero
      for (int channel = 0; channel < 3; ++channel) {
        v_color[channel] = keep(ok & gt(albedo[channel], zero), v_color[channel]);
      }
      shade_backward<kDegree>(scene, out, first, rows, p, coefficients, v_color, v_direction);
      if constexpr (kDegree > 0) {
        const Vec along = fma(v_direction[0], p.direction[0],
                              fma(v_direction[1], p.direction[1], v_direction[2] * p.direction[2]));
        for (int j = 0; j < 3; ++j) {
          v_direction[j] = keep(ok, fnma(along, p.direction[j], v_direction[j]) * p.inverse_distance);
        }
      }
    } else if (out->colors != nullptr) {
      store_rows<3>(out->colors + 3 * static_cast<size_t>(first), rows, v_color, false);
    }
    if constexpr (kPose) {
      Vec m[3];
      load_rows<3>(scene->means + 3 * static_cast<size_t>(first), rows, m);
      for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) {
          Vec term = v_point[i] * m[j];
          for (int k = 0; k < 3; ++k) {
            term = fma(v_axes[3 * i + k], p.rotation[3 * j + k] * p.scale[k], term);
          }
          if (view->lit) {
            for (int k = 0; k < 3; ++k) {
              term = fma(v_normal[i], keep(lit.shortest[k], p.rotation[3 * j + k]), term);
            }
          }
          pose[3 * i + j] = pose[3 * i + j] + finite(keep(ok, term));
        }
        pose[9 + i] = pose[9 + i] + finite(keep(ok, v_point[i]));
        pose[12 + i] = pose[12 + i] + finite(v_direction[i]);
      }
    }
    for (int j = 0; j < 3; ++j) v_mean[j] = finite(keep(ok, v_mean[j]) + v_direction[j]);
    const size_t at = static_cast<size_t>(first);
    if (out->means != nullptr) store_rows<3>(out->means + 3 * at, rows, v_mean, out->add);
    if (out->quats != nullptr) store_rows<4>(out->quats + 4 * at, rows, v_quat, out->add);
    if (out->scales != nullptr) store_rows<3>(out->scales + 3 * at, rows, v_scale, out->add);
    if (out->opacities != nullptr) {
      Vec v_opacity = finite(keep(ok, negated(s0) / max(p.opacity, Vec(kAlphaMin))));
      if (out->add) v_opacity = v_opacity + load_first(out->opacities + at, rows);
      store_first(out->opacities + at, v_opacity, rows);
    }
    const Vec v_means2d[2] = {v_u, v_v};
    if (out->means2d != nullptr) store_rows<2>(out->means2d + 2 * at, rows, v_means2d, false);
    if (out->absolute2d != nullptr) {
      const Vec absolute[2] = {load(columns + 160), load(columns + 176)};
      store_rows<2>(out->absolute2d + 2 * at, rows, absolute, false);
    }
  }
  finish_streams();
  if (view->partials.data == nullptr) return;
  float* partial = static_cast<float*>(view->partials.data) + kPartials * static_cast<size_t>(chunk);
  if constexpr (kPose) {
    for (int k = 0; k < 15; ++k) partial[k] = sum(pose[k]);
  }
  if (view->lit) {
    for (int k = 0; k < kLightLearned; ++k) partial[16 + k] = sum(finite(v_light[k]));
  }
}
