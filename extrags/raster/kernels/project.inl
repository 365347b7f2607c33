// EWA projection of Gaussians, sixteen at a time.

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
