// Transmittance at points: what is left of the light in front of a depth, at a pixel's centre.

struct Query {
  float column, row, depth;
  int32_t index;  // of the point
};

static void query_block(const uint32_t* entries, uint32_t count, const Record* locals,
                        const Query* queries, uint32_t n, float* out) {
  for (uint32_t first = 0; first < n; first += 16) {
    const uint32_t lanes = n - first < 16 ? n - first : 16;
    alignas(64) float x[16], y[16], z[16];
    for (uint32_t i = 0; i < 16; ++i) {
      const Query& q = queries[first + (i < lanes ? i : 0)];
      x[i] = q.column + 0.5f;
      y[i] = q.row + 0.5f;
      z[i] = q.depth;
    }
    const Vec px = load(x), py = load(y), limit = load(z);
    Vec transmittance(1.f), threshold(kLog2AlphaMin);
    for (uint32_t k = 0; k < count; ++k) {
      const Record& r = locals[entries[k]];
      const Mask ahead = gt(limit, Vec(r.depth));
      if (!any(ahead)) break;  // the entries are sorted by depth
      const Vec dx = Vec(r.x) - px, dy = Vec(r.y) - py;
      const Vec power = exponent(r, dx, dy);
      const Mask hit = ge(power, threshold) & ahead;
      if (!any(hit)) continue;
      const Vec alpha = min(exp2(power), Vec(kAlphaMax));
      const Vec behind = fnma(transmittance, alpha, transmittance);
      const Mask done = hit & ge(Vec(kTransmittanceMin), behind);
      threshold = select(done, Vec(1e30f), threshold);
      transmittance = select(without(hit, done), behind, transmittance);
    }
    store(x, transmittance);
    for (uint32_t i = 0; i < lanes; ++i) out[queries[first + i].index] = x[i];
  }
}

struct QueryContext {
  View* view;
  const float* points;
  int64_t count;
  float* out;
  float* projected;         // [count, 3]: column, row, depth
  int32_t* blocks;          // [count]: tile * blocks per tile + block, or -1
  uint32_t* starts;         // [blocks + 1]
  Query* sorted;            // [count]
};

constexpr int64_t kQueryChunk = 4096;

static void project_queries(void* data, int task, int) {
  const QueryContext& c = *static_cast<QueryContext*>(data);
  const View* view = c.view;
  const Camera& camera = view->camera;
  const float *r = camera.rotation, *t = camera.translation;
  const int64_t begin = task * kQueryChunk;
  const int64_t end = begin + kQueryChunk < c.count ? begin + kQueryChunk : c.count;
  const float width = static_cast<float>(view->width), height = static_cast<float>(view->height);
  for (int64_t i = begin; i < end; ++i) {
    const float* p = c.points + 3 * i;
    const float x = r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + t[0];
    const float y = r[3] * p[0] + r[4] * p[1] + r[5] * p[2] + t[1];
    const float z = r[6] * p[0] + r[7] * p[1] + r[8] * p[2] + t[2];
    c.blocks[i] = -1;
    c.out[i] = __builtin_nanf("");
    if (!(z >= view->near)) continue;
    float u = camera.fx * x / z + camera.cx, v = camera.fy * y / z + camera.cy;
    if (camera.bent) {
      const float a = x / z, b = y / z, w = a * a + b * b;
      if (!(w <= camera.lens.culled_from)) continue;
      alignas(64) float gain[16];
      store(gain, lens_gain(camera.lens, Vec(w)).value);
      u = camera.fx * (gain[0] * a) + camera.cx;
      v = camera.fy * (gain[0] * b) + camera.cy;
    }
    if (!(u >= 0 && u < width && v >= 0 && v < height)) continue;
    const int column = static_cast<int>(u), row = static_cast<int>(v);
    const int tile = row / kTilePx * view->tiles_x + column / kTilePx;
    const int block = row % kTilePx / 4 * kSide + column % kTilePx / 4;
    c.blocks[i] = tile * kBlocks + block;
    c.projected[3 * i] = static_cast<float>(column);
    c.projected[3 * i + 1] = static_cast<float>(row);
    c.projected[3 * i + 2] = z;
  }
}

static void query_tile(void* data, int tile, int) {
  const QueryContext& c = *static_cast<QueryContext*>(data);
  const View* view = c.view;
  const TileFrame t = tile_frame(view, tile);
  const uint32_t* starts = static_cast<const uint32_t*>(view->block_starts.data) + static_cast<size_t>(tile) * (kBlocks + 1);
  const uint32_t* kept = static_cast<const uint32_t*>(view->block_kept.data) + static_cast<size_t>(tile) * kBlocks;
  const Record* locals = static_cast<const Record*>(view->locals.data) + t.first_pair;
  const uint32_t* entries = static_cast<const uint32_t*>(static_cast<Buffer*>(view->tile_entries.data)[tile].data);
  for (int block = 0; block < kBlocks; ++block) {
    const size_t at = static_cast<size_t>(tile) * kBlocks + block;
    const uint32_t first = c.starts[at], n = c.starts[at + 1] - first;
    if (n == 0) continue;
    query_block(entries + starts[block], kept[block], locals, c.sorted + first, n, c.out);
  }
}

static void query(View* view, const float* points, int64_t count, float* transmittance) {
  if (count == 0) return;
  const size_t tiles = static_cast<size_t>(view->tiles_x) * view->tiles_y;
  const size_t blocks = tiles * kBlocks, n = static_cast<size_t>(count);
  reserve(&view->query, sizeof(Query) * n + sizeof(float) * 3 * n + sizeof(int32_t) * n +
                            sizeof(uint32_t) * (blocks + 2));
  QueryContext c;
  c.view = view;
  c.points = points;
  c.count = count;
  c.out = transmittance;
  c.sorted = static_cast<Query*>(view->query.data);
  c.projected = reinterpret_cast<float*>(c.sorted + n);
  c.blocks = reinterpret_cast<int32_t*>(c.projected + 3 * n);
  c.starts = reinterpret_cast<uint32_t*>(c.blocks + n);
  parallel_for(static_cast<int>((count + kQueryChunk - 1) / kQueryChunk), project_queries, &c);
  memset(c.starts, 0, sizeof(uint32_t) * (blocks + 2));
  for (size_t i = 0; i < n; ++i) {
    if (c.blocks[i] >= 0) ++c.starts[c.blocks[i] + 2];
  }
  for (size_t b = 2; b <= blocks + 1; ++b) c.starts[b] += c.starts[b - 1];
  for (size_t i = 0; i < n; ++i) {
    if (c.blocks[i] < 0) continue;
    c.sorted[c.starts[c.blocks[i] + 1]++] = Query{c.projected[3 * i], c.projected[3 * i + 1],
                                                  c.projected[3 * i + 2], static_cast<int32_t>(i)};
  }
  parallel_for(static_cast<int>(tiles), query_tile, &c);
}
