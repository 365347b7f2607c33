// Multi-view stereo: matching costs of a sweep, and semi-global optimisation. The specification, with the
// meaning of every constant, is extrags/depth/matching.py. Plain loops over rows: compilers vectorise them,
// and without contraction every instruction set gives the same bits.

struct SweepContext {
  const SweepImages* in;
  Buffer* scratch;  // [kMaxThreads]
};

constexpr float kSweepVarianceFloor = 2e-4f, kSweepNeutral = 1.f, kSweepMinWindow = 0.5f;

// Sums over windows of side 2 radius + 1; outside of the image counts as zero. `rows` is working memory of
// one image.
static void box_sums(const float* image, float* rows, float* out, int height, int width, int radius) {
  for (int y = 0; y < height; ++y) {
    const float* from = image + static_cast<int64_t>(y) * width;
    float* to = rows + static_cast<int64_t>(y) * width;
    for (int x = 0; x < width; ++x) to[x] = 0.f;
    for (int k = -radius; k <= radius; ++k) {
      const int first = k < 0 ? -k : 0, last = k > 0 ? width - k : width;
      for (int x = first; x < last; ++x) to[x] += from[x + k];
    }
  }
  for (int y = 0; y < height; ++y) {
    float* to = out + static_cast<int64_t>(y) * width;
    for (int x = 0; x < width; ++x) to[x] = 0.f;
    const int first = y - radius < 0 ? 0 : y - radius, last = y + radius >= height ? height - 1 : y + radius;
    for (int other = first; other <= last; ++other) {
      const float* from = rows + static_cast<int64_t>(other) * width;
      for (int x = 0; x < width; ++x) to[x] += from[x];
    }
  }
}

// One row of a source as the reference sees it at the hypothesised depth: brightness, and one where it counts.
static void warp_row(const SweepImages& in, const SweepSource& source, const float* own, const float* depth,
                     float ratio, int y, float* warped, float* valid) {
  const float* m = source.from_pixel;
  const int width = in.width, height = in.height;
  const float v = static_cast<float>(y) + 0.5f;
  const float x0 = m[1] * v + m[2], y0 = m[4] * v + m[5], z0 = m[7] * v + m[8];
  const float limit_u = static_cast<float>(width) - 0.5f, limit_v = static_cast<float>(height) - 0.5f;
  for (int x = 0; x < width; ++x) {
    const float u = static_cast<float>(x) + 0.5f, d = depth[x] * ratio;
    const float px = (m[0] * u + x0) * d + source.offset[0];
    const float py = (m[3] * u + y0) * d + source.offset[1];
    const float pz = (m[6] * u + z0) * d + source.offset[2];
    warped[x] = px / (pz > 1e-6f ? pz : 1e-6f);
    valid[x] = pz > 1e-6f ? py / pz : -1.f;
  }
  for (int x = 0; x < width; ++x) {
    const float su = warped[x], sv = valid[x];
    warped[x] = valid[x] = 0.f;
    if (!(own[x] > 0.f && su > 0.5f && su < limit_u && sv > 0.5f && sv < limit_v)) continue;
    const float fu = su - 0.5f, fv = sv - 0.5f;
    int column = static_cast<int>(fu), row = static_cast<int>(fv);
    if (column > width - 2) column = width - 2;
    if (row > height - 2) row = height - 2;
    const float a = fu - static_cast<float>(column), b = fv - static_cast<float>(row);
    const int64_t at = static_cast<int64_t>(row) * width + column;
    const float w00 = (1.f - a) * (1.f - b), w01 = a * (1.f - b), w10 = (1.f - a) * b, w11 = a * b;
    const float *k = source.mask + at, *g = source.grey + at;
    if (k[0] * w00 + k[1] * w01 + k[width] * w10 + k[width + 1] * w11 <= 0.99f) continue;
    warped[x] = g[0] * w00 + g[1] * w01 + g[width] * w10 + g[width + 1] * w11;
    valid[x] = 1.f;
  }
}

static void sweep_step(void* data, int step, int slot) {
  const SweepContext& c = *static_cast<SweepContext*>(data);
  const SweepImages& in = *c.in;
  const int height = in.height, width = in.width, radius = in.radius;
  const int64_t pixels = static_cast<int64_t>(height) * width;
  Buffer* buffer = c.scratch + slot;
  reserve(buffer, sizeof(float) * pixels * (10 + in.n_sources));
  float* warped = static_cast<float*>(buffer->data);
  float *valid = warped + pixels, *product = valid + pixels, *rows = product + pixels;
  float* sums = rows + pixels;      // count, a, b, aa, bb, ab
  float* costs = sums + 6 * pixels;  // one image per source
  const float side = static_cast<float>(2 * radius + 1), enough = kSweepMinWindow * side * side;
  const float ratio = in.ratios[step];
  for (int s = 0; s < in.n_sources; ++s) {
    for (int y = 0; y < height; ++y) {
      const int64_t at = static_cast<int64_t>(y) * width;
      warp_row(in, in.sources[s], in.mask + at, in.base + at, ratio, y, warped + at, valid + at);
    }
    const float* a = in.reference;
    box_sums(valid, rows, sums, height, width, radius);
    for (int64_t i = 0; i < pixels; ++i) product[i] = a[i] * valid[i];
    box_sums(product, rows, sums + pixels, height, width, radius);
    box_sums(warped, rows, sums + 2 * pixels, height, width, radius);
    for (int64_t i = 0; i < pixels; ++i) product[i] = a[i] * a[i] * valid[i];
    box_sums(product, rows, sums + 3 * pixels, height, width, radius);
    for (int64_t i = 0; i < pixels; ++i) product[i] = warped[i] * warped[i];
    box_sums(product, rows, sums + 4 * pixels, height, width, radius);
    for (int64_t i = 0; i < pixels; ++i) product[i] = a[i] * warped[i];
    box_sums(product, rows, sums + 5 * pixels, height, width, radius);
    float* cost = costs + s * pixels;
    for (int64_t i = 0; i < pixels; ++i) {
      const float count = sums[i], n = count > 1e-6f ? count : 1e-6f;
      const float mean_a = sums[pixels + i] / n, mean_b = sums[2 * pixels + i] / n;
      const float aa = sums[3 * pixels + i] / n - mean_a * mean_a, bb = sums[4 * pixels + i] / n - mean_b * mean_b;
      const float ab = sums[5 * pixels + i] / n - mean_a * mean_b;
      const float floored = ((aa > 0.f ? aa : 0.f) + kSweepVarianceFloor) * ((bb > 0.f ? bb : 0.f) + kSweepVarianceFloor);
      const float found = 1.f - ab / __builtin_sqrtf(floored);
      cost[i] = (count >= enough) & (valid[i] > 0.f) ? found : kSweepNeutral;
    }
  }
  // Odd-even transposition sorts the sources' images pixel by pixel; as many rounds as there are sources.
  for (int round = 0; round < in.n_sources; ++round) {
    for (int s = round % 2; s + 1 < in.n_sources; s += 2) {
      float *first = costs + s * pixels, *second = first + pixels;
      for (int64_t i = 0; i < pixels; ++i) {
        const float p = first[i], q = second[i];
        first[i] = p < q ? p : q;
        second[i] = p < q ? q : p;
      }
    }
  }
  float* out = in.cost + static_cast<int64_t>(step) * pixels;
  const float share = 1.f / static_cast<float>(in.kept);
  for (int64_t i = 0; i < pixels; ++i) out[i] = 0.f;
  for (int s = 0; s < in.kept; ++s) {
    const float* cost = costs + s * pixels;
    for (int64_t i = 0; i < pixels; ++i) out[i] += cost[i] * share;
  }
}

static void sweep(const SweepImages* in, Buffer* scratch) {
  SweepContext c{in, scratch};
  parallel_for(in->steps, sweep_step, &c);
}

struct PathContext {
  const SemiGlobal* in;
  float* cost;    // [h, w, d]
  float* total;   // [h, w, d]
  Buffer* scratch;
  int row_step, column_step;
};

constexpr int kPathsPerTask = 8;

static void transpose_rows(void* data, int y, int) {
  const PathContext& c = *static_cast<PathContext*>(data);
  const int width = c.in->width, steps = c.in->steps;
  const int64_t pixels = static_cast<int64_t>(c.in->height) * width;
  for (int x = 0; x < width; ++x) {
    const float* from = c.in->cost + static_cast<int64_t>(y) * width + x;
    float* to = c.cost + (static_cast<int64_t>(y) * width + x) * steps;
    float* total = c.total + (static_cast<int64_t>(y) * width + x) * steps;
    for (int k = 0; k < steps; ++k) {
      to[k] = from[k * pixels];
      total[k] = 0.f;
    }
  }
}

// All pixels from which a path of this direction starts: those without a predecessor in the image.
static int path_count(const PathContext& c) {
  const int width = c.in->width, height = c.in->height;
  if (c.row_step == 0) return height;
  return c.column_step == 0 ? width : width + height - 1;
}

static void path_start(const PathContext& c, int number, int* row, int* column) {
  const int width = c.in->width, height = c.in->height;
  if (c.row_step == 0) {
    *row = number;
    *column = c.column_step > 0 ? 0 : width - 1;
    return;
  }
  const int border_row = c.row_step > 0 ? 0 : height - 1;
  if (number < width) {
    *row = border_row;
    *column = number;
    return;
  }
  *row = border_row + c.row_step * (number - width + 1);
  *column = c.column_step > 0 ? 0 : width - 1;
}

static void follow_paths(void* data, int task, int slot) {
  const PathContext& c = *static_cast<PathContext*>(data);
  const SemiGlobal& in = *c.in;
  const int steps = in.steps, width = in.width, height = in.height, count = path_count(c);
  Buffer* buffer = c.scratch + slot;
  reserve(buffer, sizeof(float) * 2 * (steps + 2));
  float* rows[2] = {static_cast<float*>(buffer->data) + 1, static_cast<float*>(buffer->data) + steps + 3};
  for (float* row : rows) row[-1] = row[steps] = __builtin_inff();
  const int last = (task + 1) * kPathsPerTask < count ? (task + 1) * kPathsPerTask : count;
  for (int number = task * kPathsPerTask; number < last; ++number) {
    int row, column;
    path_start(c, number, &row, &column);
    float *before = rows[0], *here = rows[1];
    float lowest = 0.f, bright = 0.f;
    bool started = false;
    for (; row >= 0 && row < height && column >= 0 && column < width; row += c.row_step, column += c.column_step) {
      const int64_t at = static_cast<int64_t>(row) * width + column;
      const float* cost = c.cost + at * steps;
      float* total = c.total + at * steps;
      const float grey = in.grey[at];
      float next = __builtin_inff();
      if (!started) {
        for (int k = 0; k < steps; ++k) here[k] = cost[k];
      } else {
        const float change = grey > bright ? grey - bright : bright - grey;
        float penalty = in.jump / (1.f + change / in.edge);
        penalty = penalty > in.small_step ? penalty : in.small_step;
        const float jumped = lowest + penalty;
        for (int k = 0; k < steps; ++k) {
          const float left = before[k - 1], right = before[k + 1];
          const float neighbour = (left < right ? left : right) + in.small_step;
          float best = before[k] < neighbour ? before[k] : neighbour;
          best = best < jumped ? best : jumped;
          here[k] = cost[k] + best - lowest;
        }
      }
      for (int k = 0; k < steps; ++k) total[k] += here[k];
      for (int k = 0; k < steps; ++k) next = here[k] < next ? here[k] : next;
      lowest = next;
      bright = grey;
      started = true;
      float* swapped = before;
      before = here;
      here = swapped;
    }
  }
}

static void choose_rows(void* data, int y, int) {
  const PathContext& c = *static_cast<PathContext*>(data);
  const SemiGlobal& in = *c.in;
  const int steps = in.steps;
  for (int x = 0; x < in.width; ++x) {
    const int64_t at = static_cast<int64_t>(y) * in.width + x;
    float* total = c.total + at * steps;
    for (int k = 0; k < steps; ++k) total[k] *= 0.125f;
    int best = 0;
    for (int k = 1; k < steps; ++k) best = total[k] < total[best] ? k : best;
    const int inner = best < 1 ? 1 : (best > steps - 2 ? steps - 2 : best);
    float position = static_cast<float>(best);
    if (best == inner) {
      const float left = total[inner - 1], right = total[inner + 1], bend = left - 2.f * total[inner] + right;
      float shift = bend > 1e-9f ? 0.5f * (left - right) / bend : 0.f;
      shift = shift < -0.5f ? -0.5f : (shift > 0.5f ? 0.5f : shift);
      position += shift;
    }
    float elsewhere = __builtin_inff();
    for (int k = 0; k < steps; ++k) {
      const bool away = k < best - 2 || k > best + 2;
      elsewhere = away && total[k] < elsewhere ? total[k] : elsewhere;
    }
    in.position[at] = position;
    in.lowest[at] = total[best];
    in.margin[at] = elsewhere < __builtin_inff() ? elsewhere - total[best] : 0.f;
  }
}

static void semi_global(const SemiGlobal* in, Buffer* volume, Buffer* scratch) {
  const int64_t size = static_cast<int64_t>(in->height) * in->width * in->steps;
  reserve(volume, sizeof(float) * 2 * size);
  PathContext c{in, static_cast<float*>(volume->data), static_cast<float*>(volume->data) + size, scratch, 0, 0};
  parallel_for(in->height, transpose_rows, &c);
  constexpr int kDirections[8][2] = {{0, 1}, {0, -1}, {1, 0}, {-1, 0}, {1, 1}, {-1, -1}, {1, -1}, {-1, 1}};
  for (const auto& direction : kDirections) {
    c.row_step = direction[0];
    c.column_step = direction[1];
    parallel_for((path_count(c) + kPathsPerTask - 1) / kPathsPerTask, follow_paths, &c);
  }
  parallel_for(in->height, choose_rows, &c);
}
