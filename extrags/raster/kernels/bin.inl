// Tiles: depth sort, and exact binning of ellipses to blocks of 4 x 4 pixels.
//
// A block is one vector, lane = 4 row + column. A tile is small enough for its records, its entries and
// its gradient sums to stay in the nearest caches.

constexpr float kLog2AlphaMin = -7.994353436858858f;
constexpr int kSide = kTileBlocks, kBlocks = kSide * kSide;
constexpr int kEntriesAhead = 32;  // entries whose gradients are reduced together
constexpr int kRecordsAhead = 32;  // records of Gaussians, anywhere in memory, fetched while a tile's are copied
constexpr int kPrefetch = 8;       // entries ahead whose records are fetched

// Stable radix sort by depth. Keys are the bits of positive floats, whose order is that of the floats;
// equal depths keep the order of the ids.
static DepthKey* sort_by_depth(DepthKey* keys, DepthKey* spare, int n) {
  if (n <= 24) {
    for (int i = 1; i < n; ++i) {
      const DepthKey key = keys[i];
      int j = i;
      for (; j > 0 && keys[j - 1].depth_bits > key.depth_bits; --j) keys[j] = keys[j - 1];
      keys[j] = key;
    }
    return keys;
  }
  uint32_t low = ~0u, high = 0;
  for (int i = 0; i < n; ++i) {
    low = keys[i].depth_bits < low ? keys[i].depth_bits : low;
    high = keys[i].depth_bits > high ? keys[i].depth_bits : high;
  }
  int bits = 0;
  while (bits < 32 && (high - low) >> bits != 0) ++bits;
  constexpr int kDigit = 9, kSize = 1 << kDigit;
  uint32_t histogram[kSize];
  for (int shift = 0; shift < bits; shift += kDigit) {
    memset(histogram, 0, sizeof histogram);
    for (int i = 0; i < n; ++i) ++histogram[(keys[i].depth_bits - low) >> shift & (kSize - 1)];
    uint32_t at = 0;
    for (int d = 0; d < kSize; ++d) {
      const uint32_t count = histogram[d];
      histogram[d] = at;
      at += count;
    }
    for (int i = 0; i < n; ++i) {
      spare[histogram[(keys[i].depth_bits - low) >> shift & (kSize - 1)]++] = keys[i];
    }
    DepthKey* swapped = keys;
    keys = spare;
    spare = swapped;
  }
  return keys;
}

// Which of sixteen ellipses reach which blocks of a tile: bit `lane` of reached[block * stride].
static void block_masks(const Record* records, int rows, float tile_x, float tile_y, uint16_t* reached,
                        size_t stride) {
  alignas(64) float gathered[256], columns[256];
  for (int i = 0; i < 16; ++i) store(gathered + 16 * i, load(&records[i < rows ? i : 0].x));
  transpose16(gathered, columns);
  const Vec x = load(columns) - Vec(tile_x), y = load(columns + 16) - Vec(tile_y);
  const Vec height = load(columns + 160), slope = load(columns + 176);
  const Vec shape = load(columns + 192), right_dy = load(columns + 208);
  // Slack for rounding: the mean is known to 1e-7 of its value, the extent to 1e-6 of its own.
  const Vec slack = fma(Vec(2e-6f), height + sqrt(shape) * height, Vec(0.01f));
  const Vec top = negated(height) - slack, bottom = height + slack, square = height * height;
  const Vec quarter(0.25f), zero(0.f), left_dy = negated(right_dy);
  // A block's pixel centres lie at 4 i + 0.5 ... 4 i + 3.5.
  const Vec x_left = (x - slack + Vec(0.5f)) * quarter, x_right = (x + slack - Vec(0.5f)) * quarter;
  const Vec slope_4 = slope * quarter;
  const Mask valid = first_lanes(rows);
  for (int row = 0; row < kSide; ++row) {
    const Vec first_dy = Vec(4.f * static_cast<float>(row) + 0.5f) - y;
    const Vec low = max(first_dy, top), high = min(first_dy + Vec(3.f), bottom);
    const Mask ok = ge(high, low) & valid;
    // Between low and high the ellipse reaches furthest at its extreme points, or next to them.
    const Vec dy_right = min(max(right_dy, low), high), dy_left = min(max(left_dy, low), high);
    const Vec half_right = sqrt(max(shape * fnma(dy_right, dy_right, square), zero));
    const Vec half_left = sqrt(max(shape * fnma(dy_left, dy_left, square), zero));
    const Vec right = fma(slope_4, dy_right, fma(quarter, half_right, x_right));
    const Vec left = fma(slope_4, dy_left, fnma(quarter, half_left, x_left));
    uint16_t* out = reached + static_cast<size_t>(row) * kSide * stride;
    for (int column = 0; column < kSide; ++column) {
      const Mask hit = ok & ge(right, Vec(static_cast<float>(column))) &
                       gt(Vec(static_cast<float>(column) + 1.f), left);
      out[column * stride] = static_cast<uint16_t>(to_bits(hit));
    }
  }
}

struct TileFrame {
  int x0, y0;  // first pixel
  int blocks_x, blocks_y;  // blocks inside the image
  // What moments are taken about, in pixels from the first. It lies in the middle of what the image holds of
  // the tile: about a point far from a Gaussian, its second moments would be differences of large sums.
  float centre_x, centre_y;
  int count;   // Gaussians
  size_t first_pair;
};

static TileFrame tile_frame(const View* view, int tile) {
  const uint32_t* starts = static_cast<const uint32_t*>(view->tile_starts.data);
  TileFrame t;
  t.x0 = tile % view->tiles_x * kTilePx;
  t.y0 = tile / view->tiles_x * kTilePx;
  const int columns = (view->width - t.x0 + 3) / 4, rows = (view->height - t.y0 + 3) / 4;
  t.blocks_x = columns < kSide ? columns : kSide;
  t.blocks_y = rows < kSide ? rows : kSide;
  t.centre_x = 2.f * t.blocks_x;
  t.centre_y = 2.f * t.blocks_y;
  t.first_pair = starts[tile];
  t.count = static_cast<int>(starts[tile + 1] - starts[tile]);
  return t;
}

// Sorts a tile's Gaussians, copies their records and lists, per block, those that reach it.
static void bin_tile(View* view, int tile, int slot, const TileFrame& t) {
  const size_t groups = (static_cast<size_t>(t.count) + 15) / 16;
  const size_t masks_bytes = sizeof(uint16_t) * kBlocks * groups, keys_bytes = sizeof(DepthKey) * t.count;
  reserve(&view->scratch[slot], masks_bytes > keys_bytes ? masks_bytes : keys_bytes);
  uint32_t* starts = static_cast<uint32_t*>(view->block_starts.data) + static_cast<size_t>(tile) * (kBlocks + 1);
  Record* locals = static_cast<Record*>(view->locals.data) + t.first_pair;
  const Record* records = static_cast<const Record*>(view->records.data);
  const DepthKey* keys =
      sort_by_depth(static_cast<DepthKey*>(view->keys.data) + t.first_pair,
                    static_cast<DepthKey*>(view->scratch[slot].data), t.count);
  const uint32_t tile_x = static_cast<uint32_t>(tile % view->tiles_x);
  const uint32_t tile_y = static_cast<uint32_t>(tile / view->tiles_x);
  const uint32_t* chunk_pairs = static_cast<const uint32_t*>(view->chunk_pairs.data);
  const int chunk_bits = __builtin_ctz(static_cast<unsigned>(view->chunk));
  for (int i = 0; i < t.count && i < kRecordsAhead; ++i) __builtin_prefetch(&records[keys[i].id]);
  for (int i = 0; i < t.count; ++i) {
    __builtin_prefetch(&records[keys[i + kRecordsAhead < t.count ? i + kRecordsAhead : i].id]);
    const Record& record = records[keys[i].id];
    const uint32_t pair = record.pair + tile_y * record.tiles_across + tile_x;
    store(&locals[i].x, load(&record.x));
    locals[i].pair = pair + chunk_pairs[keys[i].id >> chunk_bits];
  }

  uint16_t* masks = static_cast<uint16_t*>(view->scratch[slot].data);
  for (size_t group = 0; group < groups; ++group) {
    const int first = static_cast<int>(16 * group), rows = t.count - first < 16 ? t.count - first : 16;
    block_masks(locals + first, rows, static_cast<float>(t.x0), static_cast<float>(t.y0), masks + group, groups);
  }
  uint64_t listed = 0;
  for (int block = 0; block < kBlocks; ++block) {
    starts[block] = static_cast<uint32_t>(listed);
    if (block % kSide >= t.blocks_x || block / kSide >= t.blocks_y) continue;
    const uint16_t* of_block = masks + groups * block;
    for (size_t group = 0; group < groups; ++group) {
      listed += static_cast<uint32_t>(__builtin_popcount(of_block[group]));
    }
  }
  check_countable(listed, "a Gaussian and a block of a tile");
  const uint32_t total = static_cast<uint32_t>(listed);
  starts[kBlocks] = total;
  Buffer* buffer = static_cast<Buffer*>(view->tile_entries.data) + tile;
  reserve(buffer, (sizeof(uint32_t) + sizeof(uint16_t)) * (static_cast<size_t>(total) + 16));
  for (int block = 0; block < kBlocks; ++block) {
    if (starts[block] == starts[block + 1]) continue;
    // Block after block: what is written beyond a block's end is overwritten by the next.
    uint32_t* entry = static_cast<uint32_t*>(buffer->data) + starts[block];
    const uint16_t* of_block = masks + groups * block;
    for (size_t group = 0; group < groups; ++group) {
      entry += append_lanes(entry, of_block[group], static_cast<uint32_t>(16 * group));
    }
  }
  // Read, never used, by the prefetch of the last block
  memset(static_cast<uint32_t*>(buffer->data) + total, 0, sizeof(uint32_t) * 16);
}
