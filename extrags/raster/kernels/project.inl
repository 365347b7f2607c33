// EWA projection of Gaussians and its gradient, sixteen at a time.

#include "lens.inl"

// How many of a task's chunk are in a group
EXTRAGS_INLINE int rows_of(int n, int first) { return n - first < 16 ? n - first : 16; }

struct Projected {
  Vec x, y, z, inverse_z;           // in the camera frame
  Vec raw_x, raw_y;                 // x / z and y / z
  Vec slope_x, slope_y;             // the same, held inside the widened image
  Mask free_x, free_y;              // where they were not held
  Vec quat[4], inverse_norm;        // unit quaternion
  Mask unit;                        // where the norm was not held
  Vec rotation[9], scale[3];        // of the Gaussian
  Vec axes[9];                      // camera rotation * rotation * scale
  Vec half[6];                      // Jacobian * axes, two rows
  Vec j00, j02, j11, j12;           // Jacobian
  Vec j01, j10;                     // the same, of a lens; zero for a pinhole
  Gain gain;                        // of the lens
  Vec image_x, image_y;             // centre in focal lengths from the principal point, of a lens
  Vec xx, xy, yy, determinant;      // 2D covariance
  Vec opacity;
  Vec direction[3], inverse_distance;
};

// Returns the lanes that pass the near plane, the opacity cut and the covariance limit.
template <bool kLens>
EXTRAGS_INLINE Mask project(const View* view, const Scene* scene, int first, int rows, Projected& p) {
  const Camera& c = view->camera;
  const float* r = c.rotation;
  Vec m[3], q[4];
  load_rows<3>(scene->means + 3 * static_cast<size_t>(first), rows, m);
  for (int i = 0; i < 3; ++i) {
    const Vec value = fma(Vec(r[3 * i]), m[0],
                          fma(Vec(r[3 * i + 1]), m[1],
                              fma(Vec(r[3 * i + 2]), m[2], Vec(c.translation[i]))));
    (i == 0 ? p.x : i == 1 ? p.y : p.z) = value;
  }
  Mask ok = ge(p.z, Vec(view->near)) & first_lanes(rows);
  p.opacity = load_first(scene->opacities + first, rows);
  ok = ok & ge(p.opacity, Vec(kAlphaMin));
  if (!any(ok)) return ok;

  p.z = select(ok, p.z, Vec(1.f));
  p.inverse_z = Vec(1.f) / p.z;
  p.raw_x = p.x * p.inverse_z;
  p.raw_y = p.y * p.inverse_z;
  if constexpr (kLens) {
    const Vec squared = fma(p.raw_x, p.raw_x, p.raw_y * p.raw_y);
    ok = ok & ge(Vec(c.lens.culled_from), squared);
    if (!any(ok)) return ok;
    p.raw_x = keep(ok, p.raw_x);
    p.raw_y = keep(ok, p.raw_y);
    p.gain = lens_gain(c.lens, keep(ok, squared));
    p.image_x = p.gain.value * p.raw_x;
    p.image_y = p.gain.value * p.raw_y;
  } else {
    const float w = static_cast<float>(view->width), h = static_cast<float>(view->height);
    const float margin_x = kFieldOfViewMargin * 0.5f * w / c.fx;
    const float margin_y = kFieldOfViewMargin * 0.5f * h / c.fy;
    const Vec low_x(-(c.cx / c.fx + margin_x)), high_x((w - c.cx) / c.fx + margin_x);
    const Vec low_y(-(c.cy / c.fy + margin_y)), high_y((h - c.cy) / c.fy + margin_y);
    p.slope_x = min(max(p.raw_x, low_x), high_x);
    p.slope_y = min(max(p.raw_y, low_y), high_y);
    p.free_x = ge(p.raw_x, low_x) & ge(high_x, p.raw_x);
    p.free_y = ge(p.raw_y, low_y) & ge(high_y, p.raw_y);
  }

  load_rows<4>(scene->quats + 4 * static_cast<size_t>(first), rows, q);
  // Scaled by its largest entry first, so that the squares neither overflow nor vanish.
  const Vec biggest = max(max(abs(q[0]), abs(q[1])), max(abs(q[2]), abs(q[3])));
  p.unit = ge(biggest, Vec(1e-12f));
  const Vec prescale = Vec(1.f) / max(biggest, Vec(1e-12f));
  for (int k = 0; k < 4; ++k) q[k] = q[k] * prescale;
  const Vec square = fma(q[0], q[0], fma(q[1], q[1], fma(q[2], q[2], q[3] * q[3])));
  const Vec inverse = Vec(1.f) / sqrt(max(square, Vec(1.f)));
  for (int k = 0; k < 4; ++k) p.quat[k] = q[k] * inverse;
  p.inverse_norm = inverse * prescale;
  const Vec qw = p.quat[0], qx = p.quat[1], qy = p.quat[2], qz = p.quat[3], one(1.f), two(2.f);
  p.rotation[0] = fnma(two, fma(qy, qy, qz * qz), one);
  p.rotation[1] = two * fnma(qw, qz, qx * qy);
  p.rotation[2] = two * fma(qw, qy, qx * qz);
  p.rotation[3] = two * fma(qw, qz, qx * qy);
  p.rotation[4] = fnma(two, fma(qx, qx, qz * qz), one);
  p.rotation[5] = two * fnma(qw, qx, qy * qz);
  p.rotation[6] = two * fnma(qw, qy, qx * qz);
  p.rotation[7] = two * fma(qw, qx, qy * qz);
  p.rotation[8] = fnma(two, fma(qx, qx, qy * qy), one);

  load_rows<3>(scene->scales + 3 * static_cast<size_t>(first), rows, p.scale);
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      p.axes[3 * i + j] = fma(Vec(r[3 * i]), p.rotation[j],
                              fma(Vec(r[3 * i + 1]), p.rotation[3 + j],
                                  Vec(r[3 * i + 2]) * p.rotation[6 + j])) * p.scale[j];
    }
  }
  p.j00 = Vec(c.fx) * p.inverse_z;
  p.j11 = Vec(c.fy) * p.inverse_z;
  if constexpr (kLens) {
    const Vec turn = two * p.gain.first, a_turn = turn * p.raw_x;
    p.j01 = p.j00 * (a_turn * p.raw_y);
    p.j10 = p.j11 * (a_turn * p.raw_y);
    p.j00 = p.j00 * fma(a_turn, p.raw_x, p.gain.value);
    p.j11 = p.j11 * fma(turn * p.raw_y, p.raw_y, p.gain.value);
    p.j02 = negated(fma(p.j00, p.raw_x, p.j01 * p.raw_y));
    p.j12 = negated(fma(p.j11, p.raw_y, p.j10 * p.raw_x));
    for (int j = 0; j < 3; ++j) {
      p.half[j] = fma(p.j00, p.axes[j], fma(p.j01, p.axes[3 + j], p.j02 * p.axes[6 + j]));
      p.half[3 + j] = fma(p.j11, p.axes[3 + j], fma(p.j10, p.axes[j], p.j12 * p.axes[6 + j]));
    }
  } else {
    p.j02 = negated(p.j00 * p.slope_x);
    p.j12 = negated(p.j11 * p.slope_y);
    for (int j = 0; j < 3; ++j) {
      p.half[j] = fma(p.j00, p.axes[j], p.j02 * p.axes[6 + j]);
      p.half[3 + j] = fma(p.j11, p.axes[3 + j], p.j12 * p.axes[6 + j]);
    }
  }
  const Vec *a = p.half, *b = p.half + 3;
  const Vec aa = fma(a[0], a[0], fma(a[1], a[1], a[2] * a[2]));
  const Vec bb = fma(b[0], b[0], fma(b[1], b[1], b[2] * b[2]));
  p.xx = aa + Vec(kDilation);
  p.yy = bb + Vec(kDilation);
  p.xy = fma(a[0], b[0], fma(a[1], b[1], a[2] * b[2]));
  // |a|^2 |b|^2 - (a.b)^2 = |a x b|^2: no cancellation, so that needles keep a sound inverse.
  const Vec n0 = fnma(a[2], b[1], a[1] * b[2]), n1 = fnma(a[0], b[2], a[2] * b[0]),
            n2 = fnma(a[1], b[0], a[0] * b[1]);
  p.determinant = fma(n0, n0, fma(n1, n1, fma(n2, n2,
                      fma(Vec(kDilation), aa + bb, Vec(kDilation * kDilation)))));
  ok = ok & ge(Vec(kCovarianceMax), p.xx) & ge(Vec(kCovarianceMax), p.yy);

  Vec offset[3];
  for (int j = 0; j < 3; ++j) {
    const float centre = -(r[j] * c.translation[0] + r[3 + j] * c.translation[1] +
                           r[6 + j] * c.translation[2]);
    offset[j] = m[j] - Vec(centre);
  }
  const Vec squared = fma(offset[0], offset[0],
                          fma(offset[1], offset[1], fma(offset[2], offset[2], Vec(1e-20f))));
  p.inverse_distance = Vec(1.f) / sqrt(squared);
  for (int j = 0; j < 3; ++j) p.direction[j] = offset[j] * p.inverse_distance;
  return ok;
}

// The colours
#include "harmonics.inl"
#include "light.inl"

EXTRAGS_INLINE void mark_culled(View* view, const Images* out, int first, int rows, uint32_t pair) {
  TileRect* rects = static_cast<TileRect*>(view->rects.data);
  uint32_t* starts = static_cast<uint32_t*>(view->pair_starts.data);
  for (int i = first; i < first + rows; ++i) {
    rects[i] = TileRect{1, 1, 0, 0};
    starts[i] = pair;
    out->radius[i] = 0;
    out->means2d[2 * i] = out->means2d[2 * i + 1] = 0;
  }
}

// Projects one chunk of Gaussians and counts the tiles they touch.
template <int kDegree, bool kColors, bool kLens>
static void project_chunk(View* view, const Scene* scene, const Images* out, int chunk) {
  Record* records = static_cast<Record*>(view->records.data);
  TileRect* rects = static_cast<TileRect*>(view->rects.data);
  uint32_t* starts = static_cast<uint32_t*>(view->pair_starts.data);  // from the chunk's first, for now
  uint32_t* depths = static_cast<uint32_t*>(view->depths.data);
  const int tiles = view->tiles_x * view->tiles_y;
  uint32_t* counts = static_cast<uint32_t*>(view->counts.data) + static_cast<size_t>(chunk) * tiles;
  memset(counts, 0, sizeof(uint32_t) * tiles);
  const int begin = chunk * view->chunk;
  const int end = begin + view->chunk < scene->n ? begin + view->chunk : scene->n;
  const float per_tile = 1.f / kTilePx;
  uint32_t pairs = 0;
  for (int first = begin; first < end; first += 16) {
    const int rows = rows_of(end, first);
    Projected p;
    Mask ok = project<kLens>(view, scene, first, rows, p);
    if (!any(ok)) {
      mark_culled(view, out, first, rows, pairs);
      continue;
    }
    const Vec u = fma(Vec(view->camera.fx), kLens ? p.image_x : p.raw_x, Vec(view->camera.cx));
    const Vec v = fma(Vec(view->camera.fy), kLens ? p.image_y : p.raw_y, Vec(view->camera.cy));
    const Vec log2_opacity = log2(max(p.opacity, Vec(kAlphaMin)));
    // alpha = 1/255 where the squared Mahalanobis distance is `reach`
    const Vec reach = max(Vec(2 * kLn2) * (log2_opacity + Vec(7.994353436858858f)), Vec(0.f));
    const Vec extent_x = sqrt(reach * p.xx), extent_y = sqrt(reach * p.yy);
    const Vec w(static_cast<float>(view->width)), h(static_cast<float>(view->height));
    ok = ok & gt(u + extent_x, Vec(0.f)) & gt(w, u - extent_x) & gt(v + extent_y, Vec(0.f)) &
         gt(h, v - extent_y);
    const uint32_t seen = to_bits(ok);
    if (seen == 0) {
      mark_culled(view, out, first, rows, pairs);
      continue;
    }
    Vec color[3];
    if constexpr (kColors) {
      load_rows<3>(scene->colors + 3 * static_cast<size_t>(first), rows, color);
    } else {
      alignas(64) float coefficients[48 * 16];
      shade<kDegree>(scene, first, rows, p, coefficients, color);
    }
    if (view->lit) {
      Lit lit;
      illuminate(view, p, lit);
      develop(view, lit, color);
    }
    const Vec inverse = Vec(1.f) / p.determinant, inverse_yy = Vec(1.f) / p.yy;
    alignas(64) float fields[256], packed[256];
    const Vec columns[16] = {
        u, v,
        Vec(-0.5f * kLog2E) * (p.yy * inverse), Vec(kLog2E) * (p.xy * inverse),
        Vec(-0.5f * kLog2E) * (p.xx * inverse),
        log2_opacity, color[0], color[1], color[2], p.z,
        extent_y, p.xy * inverse_yy, p.determinant * inverse_yy * inverse_yy,
        p.xy * extent_x / p.xx,
        Vec(0.f), Vec(0.f)};
    for (int k = 0; k < 16; ++k) store(fields + 16 * k, columns[k]);
    transpose16(fields, packed);
    alignas(64) uint32_t corner0[16], corner1[16];
    const Vec zero(0.f), last_x(static_cast<float>(view->tiles_x - 1)),
        last_y(static_cast<float>(view->tiles_y - 1)), scale(per_tile);
    store_packed(corner0, min(max((u - extent_x) * scale, zero), last_x),
                 min(max((v - extent_y) * scale, zero), last_y));
    store_packed(corner1, min(max((u + extent_x) * scale, zero), last_x),
                 min(max((v + extent_y) * scale, zero), last_y));
    alignas(64) float radius[16];
    store(radius, keep(ok, max(max(extent_x, extent_y), Vec(1e-6f))));
    for (int i = 0; i < rows; ++i) {
      const int id = first + i;
      out->radius[id] = radius[i];
      if ((seen >> i & 1) == 0) {
        mark_culled(view, out, id, 1, pairs);
        continue;
      }
      Record* record = records + id;
      store(&record->x, load(packed + 16 * i));
      out->means2d[2 * id] = record->x;
      out->means2d[2 * id + 1] = record->y;
      const TileRect rect{static_cast<uint16_t>(corner0[i]), static_cast<uint16_t>(corner0[i] >> 16),
                          static_cast<uint16_t>(corner1[i]), static_cast<uint16_t>(corner1[i] >> 16)};
      rects[id] = rect;
      memcpy(depths + id, &record->depth, sizeof *depths);
      // Unsigned arithmetic wraps: only the number of a tile the Gaussian touches means anything.
      const uint32_t across = rect.x1 - rect.x0 + 1u;
      record->tiles_across = across;
      record->pair = pairs - rect.y0 * across - rect.x0;
      starts[id] = pairs;
      pairs += across * (rect.y1 - rect.y0 + 1u);
      for (int ty = rect.y0; ty <= rect.y1; ++ty) {
        for (int tx = rect.x0; tx <= rect.x1; ++tx) ++counts[ty * view->tiles_x + tx];
      }
    }
  }
  static_cast<uint32_t*>(view->chunk_pairs.data)[chunk] = pairs;
}

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
  Vec pose[15], v_light[11];
  for (int k = 0; k < 15; ++k) pose[k] = zero;
  for (int k = 0; k < 11; ++k) v_light[k] = zero;
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
    for (int k = 0; k < 11; ++k) partial[16 + k] = sum(finite(v_light[k]));
  }
}
