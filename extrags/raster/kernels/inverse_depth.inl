// Mean absolute difference of inverse depths with its gradient; the formula is in loss.py.

constexpr int64_t kDepthPixels = 8192;  // a task

struct DepthContext {
  const DepthImages* images;
  double* sums;     // per task
  int64_t* counts;  // per task: pixels compared
  float factor;     // of the gradient
};

EXTRAGS_INLINE Vec confidence_at(const DepthImages& d, int64_t i, int lanes) {
  return d.confidence == nullptr ? Vec(1.f) : load_first(d.confidence + i, lanes);
}

struct DepthVector {
  Mask valid;
  Vec difference, slope;  // of scale over depths, and its derivative
};

EXTRAGS_INLINE DepthVector compare_depths(const DepthImages& d, int64_t i, int lanes) {
  const Vec depth = load_first(d.depth + i, lanes), target = load_first(d.target + i, lanes);
  const Vec zero(0.f), scale(d.scale);
  const Mask valid = gt(target, zero) & gt(load_first(d.alpha + i, lanes), Vec(0.5f)) &
                     gt(depth, Vec(1e-3f * d.scale));
  const Vec one(1.f), inverse = one / select(valid, depth, one), inverse_target = one / select(valid, target, one);
  // Equal depths differ by nothing.
  const Vec difference = keep(valid, inverse * scale - inverse_target * scale);
  return {valid, difference, negated(scale * inverse * inverse)};
}

static void sum_depths(void* data, int task, int) {
  const DepthContext& c = *static_cast<DepthContext*>(data);
  const int64_t begin = task * kDepthPixels, pixels = c.images->pixels;
  const int64_t end = begin + kDepthPixels < pixels ? begin + kDepthPixels : pixels;
  Vec total(0.f);
  int64_t count = 0;
  for (int64_t i = begin; i < end; i += 16) {
    const int lanes = end - i < 16 ? static_cast<int>(end - i) : 16;
    const DepthVector v = compare_depths(*c.images, i, lanes);
    // What is not compared may have any confidence, NaN too.
    total = total + keep(v.valid, abs(v.difference) * confidence_at(*c.images, i, lanes));
    count += __builtin_popcount(to_bits(v.valid));
  }
  c.sums[task] = static_cast<double>(sum(total));
  c.counts[task] = count;
}

static void carry_depths(void* data, int task, int) {
  const DepthContext& c = *static_cast<DepthContext*>(data);
  const int64_t begin = task * kDepthPixels, pixels = c.images->pixels;
  const int64_t end = begin + kDepthPixels < pixels ? begin + kDepthPixels : pixels;
  const Vec zero(0.f), up(c.factor), down(-c.factor);
  for (int64_t i = begin; i < end; i += 16) {
    const int lanes = end - i < 16 ? static_cast<int>(end - i) : 16;
    const DepthVector v = compare_depths(*c.images, i, lanes);
    const Vec sign = keep(gt(v.difference, zero), up) + keep(gt(zero, v.difference), down);
    store_first(c.images->gradient + i, keep(v.valid, sign * v.slope * confidence_at(*c.images, i, lanes)), lanes);
  }
}

// Returns the weighted loss; where nothing can be compared it and the gradient are zero.
static double inverse_depth(const DepthImages* images, Buffer* working, int64_t* compared) {
  const int tasks = static_cast<int>((images->pixels + kDepthPixels - 1) / kDepthPixels);
  reserve(working, (sizeof(double) + sizeof(int64_t)) * tasks);
  DepthContext c{images, static_cast<double*>(working->data), nullptr, 0.f};
  c.counts = reinterpret_cast<int64_t*>(c.sums + tasks);
  parallel_for(tasks, sum_depths, &c);
  double total = 0;
  *compared = 0;
  for (int task = 0; task < tasks; ++task) {
    total += c.sums[task];
    *compared += c.counts[task];
  }
  const double share = *compared == 0 ? 0 : static_cast<double>(images->weight) / static_cast<double>(*compared);
  c.factor = static_cast<float>(share);
  parallel_for(tasks, carry_depths, &c);
  return share * total;
}
