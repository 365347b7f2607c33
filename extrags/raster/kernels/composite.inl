// Compositing of a tile and its gradient.

#include "bin.inl"

EXTRAGS_INLINE void block_lanes(Vec* column, Vec* row) {
  alignas(64) static const float x[16] = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
  alignas(64) static const float y[16] = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};
  *column = load(x);
  *row = load(y);
}

// Exponent of alpha in powers of two
EXTRAGS_INLINE Vec exponent(const Record& r, Vec dx, Vec dy) {
  return fma(dx, fma(Vec(r.xx), dx, Vec(r.xy) * dy), fma(Vec(r.yy) * dy, dy, Vec(r.log2_opacity)));
}

EXTRAGS_INLINE void put_block(float* image, const View* view, int x0, int y0, Vec value) {
  alignas(64) float t[16];
  store(t, value);
  const int rows = view->height - y0 < 4 ? view->height - y0 : 4;
  const int columns = view->width - x0 < 4 ? view->width - x0 : 4;
  float* to = image + static_cast<size_t>(y0) * view->width + x0;
  if (columns == 4) {
    for (int j = 0; j < rows; ++j, to += view->width) memcpy(to, t + 4 * j, 16);
  } else {
    for (int j = 0; j < rows; ++j, to += view->width) memcpy(to, t + 4 * j, sizeof(float) * columns);
  }
}

EXTRAGS_INLINE void put_color_block(float* image, const View* view, int x0, int y0, const Vec* color) {
  alignas(64) float t[48];
  store_triples(t, color);
  const int rows = view->height - y0 < 4 ? view->height - y0 : 4;
  const int columns = view->width - x0 < 4 ? view->width - x0 : 4;
  float* to = image + 3 * (static_cast<size_t>(y0) * view->width + x0);
  if (columns == 4) {
    for (int j = 0; j < rows; ++j, to += 3 * view->width) memcpy(to, t + 12 * j, 48);
  } else {
    for (int j = 0; j < rows; ++j, to += 3 * view->width) memcpy(to, t + 12 * j, sizeof(float) * 3 * columns);
  }
}

EXTRAGS_INLINE Vec get_block(const float* image, const View* view, int x0, int y0) {
  alignas(64) float t[16] = {};
  const int rows = view->height - y0 < 4 ? view->height - y0 : 4;
  const int columns = view->width - x0 < 4 ? view->width - x0 : 4;
  const float* from = image + static_cast<size_t>(y0) * view->width + x0;
  if (columns == 4) {
    for (int j = 0; j < rows; ++j, from += view->width) memcpy(t + 4 * j, from, 16);
  } else {
    for (int j = 0; j < rows; ++j, from += view->width) memcpy(t + 4 * j, from, sizeof(float) * columns);
  }
  return load(t);
}

EXTRAGS_INLINE void get_color_block(const float* image, const View* view, int x0, int y0, Vec* color) {
  alignas(64) float t[48] = {};
  const int rows = view->height - y0 < 4 ? view->height - y0 : 4;
  const int columns = view->width - x0 < 4 ? view->width - x0 : 4;
  const float* from = image + 3 * (static_cast<size_t>(y0) * view->width + x0);
  if (columns == 4) {
    for (int j = 0; j < rows; ++j, from += 3 * view->width) memcpy(t + 12 * j, from, 48);
  } else {
    for (int j = 0; j < rows; ++j, from += 3 * view->width) memcpy(t + 12 * j, from, sizeof(float) * 3 * columns);
  }
  load_triples(t, color);
}

// Beside a tile's entries: for each that was kept, the pixels that composited it.
EXTRAGS_INLINE uint16_t* entry_hits(uint32_t* entries, uint32_t total) {
  return reinterpret_cast<uint16_t*>(entries + total + 16);
}

// Composites the blocks of a tile front to back. Entries that no pixel composited or ended at are dropped from
// the lists.
template <bool kMedian, bool kVisibility>
static void composite_tile(View* view, const Images* out, int tile, const TileFrame& t, float* visibility) {
  const uint32_t* starts = static_cast<const uint32_t*>(view->block_starts.data) + static_cast<size_t>(tile) * (kBlocks + 1);
  uint32_t* kept_counts = static_cast<uint32_t*>(view->block_kept.data) + static_cast<size_t>(tile) * kBlocks;
  float* finals = static_cast<float*>(view->finals.data) + static_cast<size_t>(tile) * kBlocks * 16;
  const Record* locals = static_cast<const Record*>(view->locals.data) + t.first_pair;
  uint32_t* all_entries = static_cast<uint32_t*>(static_cast<Buffer*>(view->tile_entries.data)[tile].data);
  uint16_t* all_hits = entry_hits(all_entries, starts[kBlocks]);
  Vec lane_x, lane_y;
  block_lanes(&lane_x, &lane_y);
  const Vec alpha_max(kAlphaMax), transmittance_min(kTransmittanceMin), one(1.f), half(0.5f);
  const Vec finished(1e30f);
  for (int by = 0; by < t.blocks_y; ++by) {
    for (int bx = 0; bx < t.blocks_x; ++bx) {
      const int block = by * kSide + bx, x0 = t.x0 + 4 * bx, y0 = t.y0 + 4 * by;
      const Vec px = lane_x + Vec(x0 + 0.5f), py = lane_y + Vec(y0 + 0.5f);
      uint32_t* entries = all_entries + starts[block];
      uint16_t* hits = all_hits + starts[block];
      const uint32_t count = starts[block + 1] - starts[block];
      Vec transmittance(1.f), red(0.f), green(0.f), blue(0.f), depth(0.f), median(0.f);
      // Lanes outside the image are finished from the start.
      const Mask inside = gt(Vec(static_cast<float>(view->width)), px) & gt(Vec(static_cast<float>(view->height)), py);
      Vec threshold = select(inside, Vec(kLog2AlphaMin), finished);
      Vec counted(1.f);
      if constexpr (kVisibility) {
        if (out->visibility_mask != nullptr) counted = get_block(out->visibility_mask, view, x0, y0);
      }
      uint32_t kept = 0;
      for (uint32_t k = 0; k < count; ++k) {
        const uint32_t local = entries[k];
        const Record& r = locals[local];
        const Vec dx = Vec(r.x) - px, dy = Vec(r.y) - py;
        const Vec power = exponent(r, dx, dy);
        Mask hit = ge(power, threshold);
        if (!any(hit)) continue;
        const Vec alpha = min(exp2(power), alpha_max);
        const Vec behind = fnma(transmittance, alpha, transmittance);
        const Mask done = hit & ge(transmittance_min, behind);
        if (__builtin_expect(any(done), 0)) {
          threshold = select(done, finished, threshold);
          hit = without(hit, done);
          if (!any(hit)) {
            if (!any(gt(finished, threshold))) break;
            // No pixel composites it, but queries must find where this one ended.
            hits[kept] = 0;
            entries[kept++] = local;
            continue;
          }
        }
        const Vec weight = keep(hit, transmittance * alpha);
        red = fma(weight, Vec(r.color[0]), red);
        green = fma(weight, Vec(r.color[1]), green);
        blue = fma(weight, Vec(r.color[2]), blue);
        depth = fma(weight, Vec(r.depth), depth);
        if constexpr (kMedian) {
          const Mask crossing = hit & gt(transmittance, half) & ge(half, behind);
          median = select(crossing, Vec(r.depth), median);
        }
        if constexpr (kVisibility) {
          float* of_local = visibility + 2 * static_cast<size_t>(local);
          const Vec shown = weight * counted;
          const float best = largest(shown);
          of_local[0] = best > of_local[0] ? best : of_local[0];
          of_local[1] += sum(shown);
        }
        transmittance = select(hit, behind, transmittance);
        hits[kept] = static_cast<uint16_t>(to_bits(hit));
        entries[kept++] = local;
      }
      kept_counts[block] = kept;
      store(finals + 16 * block, transmittance);
      const Vec color[3] = {fma(transmittance, Vec(view->background[0]), red),
                            fma(transmittance, Vec(view->background[1]), green),
                            fma(transmittance, Vec(view->background[2]), blue)};
      const Vec alpha = one - transmittance;
      put_color_block(out->rgb, view, x0, y0, color);
      put_block(out->alpha, view, x0, y0, alpha);
      put_block(out->depth, view, x0, y0, depth / max(alpha, Vec(kAlphaEps)));
      if constexpr (kMedian) put_block(out->median_depth, view, x0, y0, median);
    }
  }
}

static void forward_tile(View* view, const Images* out, int tile, int slot) {
  const TileFrame t = tile_frame(view, tile);
  bin_tile(view, tile, slot, t);
  const bool median = out->median_depth != nullptr;
  if (out->visibility_max == nullptr) {
    if (median) {
      composite_tile<true, false>(view, out, tile, t, nullptr);
    } else {
      composite_tile<false, false>(view, out, tile, t, nullptr);
    }
    return;
  }
  // Binning has finished with the scratch memory.
  reserve(&view->scratch[slot], sizeof(float) * 2 * (t.count + 1));
  float* visibility = static_cast<float*>(view->scratch[slot].data);
  memset(visibility, 0, sizeof(float) * 2 * t.count);
  if (median) {
    composite_tile<true, true>(view, out, tile, t, visibility);
  } else {
    composite_tile<false, true>(view, out, tile, t, visibility);
  }
  const Record* locals = static_cast<const Record*>(view->locals.data) + t.first_pair;
  float* rows = static_cast<float*>(view->pair_rows.data);
  for (int i = 0; i < t.count; ++i) {
    memcpy(rows + 2 * static_cast<size_t>(locals[i].pair), visibility + 2 * i, 2 * sizeof(float));
  }
}

// Places in a row of gradient sums. With pixel coordinates (X, Y) about the tile's centre, rows hold minus the
// sums of g, gX, gY, gXX, gXY, gYY, those of |g du| and |g dv|, and those of the weight times the gradient of
// red, green, blue and depth. The Gaussian's mean about the tile's centre travels along: nothing is added to it.
enum SumPlace {
  kSum = 0, kSumX = 4, kSumY = 8, kSumXX = 12, kSumXY = 1, kSumYY = 5, kSumAbsU = 9, kSumAbsV = 13,
  kSumRed = 2, kSumGreen = 6, kSumBlue = 10, kSumDepth = 14, kSumMeanX = 3, kSumMeanY = 7
};
constexpr int kTogether = 4;  // entries whose gradients share vectors

// Working memory of a tile's backward pass
struct TileWork {
  float (*sums)[16];
  float g[kEntriesAhead][16], weight[kEntriesAhead][16];  // of a block's pixels
  // Per column of a block: X in the first place, its square in the next, the gradients of red, green, blue and
  // depth of the four pixels, each over a quad
  float column_x[4][2];
  float column_gradients[4][4][16];
};

// Adds `count` entries, the last first, to the sums of their Gaussians; `y` holds the Y of the pixels. Four
// entries at a time are turned round so that a vector holds a column: lane 4 row + entry. Sums over columns then
// take no permutation, and those over rows yield four sums of four entries together.
EXTRAGS_INLINE void reduce_entries(const TileWork* work, Vec y, const uint32_t* entries, int count) {
  for (int k = 0; k < count; k += kTogether) {
    // What the last, incomplete ones hold beyond `count` is not added.
    Vec g[4], w[4];
    for (int i = 0; i < 4; ++i) g[i] = load(work->g[k + i]);
    transpose_in_quads(g);
    const Vec total = (g[0] + g[1]) + (g[2] + g[3]);
    Vec total_x = Vec(work->column_x[0][0]) * g[0], total_xx = Vec(work->column_x[0][1]) * g[0];
    for (int i = 1; i < 4; ++i) {
      total_x = fma(Vec(work->column_x[i][0]), g[i], total_x);
      total_xx = fma(Vec(work->column_x[i][1]), g[i], total_xx);
    }
    const Vec total_y = y * total;
    for (int i = 0; i < 4; ++i) w[i] = load(work->weight[k + i]);
    transpose_in_quads(w);
    Vec color[4];
    for (int channel = 0; channel < 4; ++channel) {
      color[channel] = load(work->column_gradients[0][channel]) * w[0];
      for (int i = 1; i < 4; ++i) {
        color[channel] = fma(load(work->column_gradients[i][channel]), w[i], color[channel]);
      }
    }
    const Vec zero(0.f);
    Vec rows[4] = {sum_quads(total, total_x, total_y, total_xx), sum_quads(y * total_x, y * total_y, zero, zero),
                   sum_quads(color[0], color[1], color[2], color[3]), zero};
    transpose_in_quads(rows);
    for (int i = 0; i < kTogether; ++i) {
      if (k + i >= count) break;
      float* row = work->sums[entries[-k - i]];
      store(row, load(row) + rows[i]);
    }
  }
}

// Gradients of the loss with respect to one block's pixels.
struct PixelGradients {
  Vec red, green, blue, depth;
  Vec behind;  // of the final transmittance
};

EXTRAGS_INLINE PixelGradients pixel_gradients(const View* view, const ImageGradients* in, int x0, int y0,
                                              Vec transmittance) {
  PixelGradients v;
  Vec color[3] = {Vec(0.f), Vec(0.f), Vec(0.f)};
  if (in->rgb != nullptr) get_color_block(in->rgb, view, x0, y0, color);
  v.red = color[0];
  v.green = color[1];
  v.blue = color[2];
  Vec alpha = in->alpha != nullptr ? get_block(in->alpha, view, x0, y0) : Vec(0.f);
  v.depth = Vec(0.f);
  if (in->depth != nullptr) {
    const Vec hit = Vec(1.f) - transmittance;
    v.depth = get_block(in->depth, view, x0, y0) / max(hit, Vec(kAlphaEps));
    alpha = alpha - keep(gt(hit, Vec(kAlphaEps)), v.depth * get_block(in->depth_image, view, x0, y0));
  }
  v.behind = fma(v.red, Vec(view->background[0]),
                 fma(v.green, Vec(view->background[1]),
                     fma(v.blue, Vec(view->background[2]), negated(alpha))));
  return v;
}

template <bool kAbsolute>
static void block_backward(const View* view, const ImageGradients* in, const TileFrame& t, int block,
                           const Record* locals, const uint32_t* entries, const uint16_t* hits, uint32_t kept,
                           Vec transmittance, TileWork* work) {
  const int x0 = t.x0 + 4 * (block % kSide), y0 = t.y0 + 4 * (block / kSide);
  Vec lane_x, lane_y;
  block_lanes(&lane_x, &lane_y);
  const Vec px = lane_x + Vec(x0 + 0.5f), py = lane_y + Vec(y0 + 0.5f);
  const PixelGradients v = pixel_gradients(view, in, x0, y0, transmittance);
  for (int i = 0; i < 4; ++i) {
    const float x = static_cast<float>(x0 + i - t.x0) + 0.5f - t.centre_x;
    work->column_x[i][0] = x;
    work->column_x[i][1] = x * x;
  }
  const Vec y = lane_y + Vec(y0 + 0.5f - t.y0 - t.centre_y);
  const Vec gradients[4] = {v.red, v.green, v.blue, v.depth};
  for (int channel = 0; channel < 4; ++channel) {
    store(work->column_gradients[0][channel], splat_in_quads<0>(gradients[channel]));
    store(work->column_gradients[1][channel], splat_in_quads<1>(gradients[channel]));
    store(work->column_gradients[2][channel], splat_in_quads<2>(gradients[channel]));
    store(work->column_gradients[3][channel], splat_in_quads<3>(gradients[channel]));
  }
  const Vec alpha_max(kAlphaMax), one(1.f);
  Vec behind = v.behind;
  for (int left = static_cast<int>(kept); left > 0;) {
    const int count = left < kEntriesAhead ? left : kEntriesAhead;
    for (int i = 0; i < count; ++i) {
      const int k = left - 1 - i;
      const uint32_t local = entries[k], later = entries[k < kPrefetch ? 0 : k - kPrefetch];
      __builtin_prefetch(locals + later);
      __builtin_prefetch(work->sums[later], 1);
      const Record& r = locals[local];
      const Vec dx = Vec(r.x) - px, dy = Vec(r.y) - py;
      const Vec power = exponent(r, dx, dy);
      const Mask hit = from_bits(hits[k]);
      const Vec raw = exp2(power), alpha = keep(hit, min(raw, alpha_max));
      transmittance = transmittance * (one / (one - alpha));
      // `behind` is the gradient-weighted value of all that lies behind, per unit of transmittance.
      const Vec own = fma(v.red, Vec(r.color[0]),
                          fma(v.green, Vec(r.color[1]), fma(v.blue, Vec(r.color[2]), v.depth * Vec(r.depth))));
      const Vec difference = own - behind;
      behind = fma(alpha, difference, behind);
      const Vec weight = transmittance * alpha;
      // minus d loss / d (half the squared Mahalanobis distance); none where alpha was clipped
      const Vec g = keep(ge(alpha_max, raw), weight * difference);
      store(work->g[i], g);
      store(work->weight[i], weight);
      if constexpr (kAbsolute) {
        const Vec scale(-1.f / kLog2E), two(2.f);
        float* row = work->sums[local];
        const Vec du = scale * fma(two * Vec(r.xx), dx, Vec(r.xy) * dy);
        const Vec dv = scale * fma(two * Vec(r.yy), dy, Vec(r.xy) * dx);
        row[kSumAbsU] += sum(abs(g * du));
        row[kSumAbsV] += sum(abs(g * dv));
      }
    }
    reduce_entries(work, y, entries + left - 1, count);
    left -= count;
  }
}

// Turns sums about the tile's centre into moments about each Gaussian's mean, and files them by pair: whole cache
// lines in no order, written past the caches.
static void file_pair_rows(View* view, const TileFrame& t, const float (*sums)[16]) {
  const Record* locals = static_cast<const Record*>(view->locals.data) + t.first_pair;
  float* out = static_cast<float*>(view->pair_rows.data);
  alignas(64) float columns[256], rows[256];
  for (int first = 0; first < t.count; first += 16) {
    const int count = t.count - first < 16 ? t.count - first : 16;
    transpose16(sums[first], columns);
    const Vec mx = load(columns + 16 * kSumMeanX), my = load(columns + 16 * kSumMeanY);
    // The sums hold minus the gradient.
    const Vec s0 = negated(load(columns + 16 * kSum));
    const Vec sx = negated(load(columns + 16 * kSumX)), sy = negated(load(columns + 16 * kSumY));
    const Vec sxx = negated(load(columns + 16 * kSumXX)), sxy = negated(load(columns + 16 * kSumXY));
    const Vec syy = negated(load(columns + 16 * kSumYY));
    const Vec dx = fma(mx, s0, negated(sx)), dy = fma(my, s0, negated(sy));
    const Vec moments[16] = {
        s0, dx, dy,
        fma(mx, dx, fnma(mx, sx, sxx)), fma(mx, dy, fnma(my, sx, sxy)), fma(my, dy, fnma(my, sy, syy)),
        load(columns + 16 * kSumRed), load(columns + 16 * kSumGreen), load(columns + 16 * kSumBlue),
        load(columns + 16 * kSumDepth), load(columns + 16 * kSumAbsU), load(columns + 16 * kSumAbsV),
        Vec(0.f), Vec(0.f), Vec(0.f), Vec(0.f)};
    for (int k = 0; k < 16; ++k) store(columns + 16 * k, moments[k]);
    transpose16(columns, rows);
    for (int i = 0; i < count; ++i) {
      stream(out + 16 * static_cast<size_t>(locals[first + i].pair), load(rows + 16 * i));
    }
  }
  finish_streams();
}

static void backward_tile(View* view, const ImageGradients* in, bool absolute, int tile, int slot) {
  const TileFrame t = tile_frame(view, tile);
  if (t.count == 0) return;
  const uint32_t* starts = static_cast<const uint32_t*>(view->block_starts.data) + static_cast<size_t>(tile) * (kBlocks + 1);
  const uint32_t* kept = static_cast<const uint32_t*>(view->block_kept.data) + static_cast<size_t>(tile) * kBlocks;
  const float* finals = static_cast<const float*>(view->finals.data) + static_cast<size_t>(tile) * kBlocks * 16;
  const Record* locals = static_cast<const Record*>(view->locals.data) + t.first_pair;
  uint32_t* entries = static_cast<uint32_t*>(static_cast<Buffer*>(view->tile_entries.data)[tile].data);
  const uint16_t* hits = entry_hits(entries, starts[kBlocks]);
  // Whole groups of sixteen, as they are filed
  const int padded = (t.count + 15) / 16 * 16;
  reserve(&view->scratch[slot], sizeof(float) * 16 * padded);
  alignas(64) TileWork work;
  work.sums = static_cast<float(*)[16]>(view->scratch[slot].data);
  for (int i = 0; i < padded; ++i) {
    store(work.sums[i], Vec(0.f));
    if (i >= t.count) continue;
    work.sums[i][kSumMeanX] = locals[i].x - (t.x0 + t.centre_x);
    work.sums[i][kSumMeanY] = locals[i].y - (t.y0 + t.centre_y);
  }
  for (int by = 0; by < t.blocks_y; ++by) {
    for (int bx = 0; bx < t.blocks_x; ++bx) {
      const int block = by * kSide + bx;
      if (kept[block] == 0) continue;
      const Vec transmittance = load(finals + 16 * block);
      if (absolute) {
        block_backward<true>(view, in, t, block, locals, entries + starts[block], hits + starts[block],
                             kept[block], transmittance, &work);
      } else {
        block_backward<false>(view, in, t, block, locals, entries + starts[block], hits + starts[block],
                              kept[block], transmittance, &work);
      }
    }
  }
  file_pair_rows(view, t, work.sums);
}
