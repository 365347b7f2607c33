// Adam over arrays that share their rows; the rule is in adam.py.

constexpr float kAdamGradientMax = 1e18f;

struct AdamFactors {
  Vec beta1, beta2, rest1, rest2, scale, eps;
};

EXTRAGS_INLINE void adam_vector(const AdamFactors& f, Vec step, Vec gradient, Vec* p, Vec* m, Vec* v) {
  // Where one is NaN, both operations give their second argument: it is to be seen, not to become a number.
  const Vec g = min(Vec(kAdamGradientMax), max(Vec(-kAdamGradientMax), gradient));
  *m = fma(f.beta1, *m, f.rest1 * g);
  *v = fma(f.beta2, *v, f.rest2 * g * g);
  *p = *p - step * *m / fma(sqrt(*v), f.scale, f.eps);
}

// Steps rows [begin, end) of one array; they share their bias corrections.
template <bool kRates>
static void adam_run(const AdamStep& a, const AdamArray& array, int64_t begin, int64_t end, float bias1,
                     float bias2) {
  const AdamFactors f{Vec(a.beta1), Vec(a.beta2), Vec(a.rest1), Vec(a.rest2), Vec(bias2), Vec(a.eps)};
  const Vec bias(bias1);
  Vec step(array.rate * bias1);
  const int64_t offset = begin * array.columns, count = (end - begin) * array.columns;
  float *values = array.values + offset, *first = array.first + offset, *second = array.second + offset;
  const float* gradients = array.gradients + offset;
  int64_t i = 0, column = 0;
  for (; i + 16 <= count; i += 16) {
    Vec p = load(values + i), m = load(first + i), v = load(second + i);
    if (kRates) {
      step = load(array.rates + column) * bias;
      column += 16;
      while (column >= array.columns) column -= array.columns;
    }
    adam_vector(f, step, load(gradients + i), &p, &m, &v);
    store(values + i, p);
    store(first + i, m);
    store(second + i, v);
  }
  if (i == count) return;
  if (kRates) step = load(array.rates + column) * bias;
  const int rest = static_cast<int>(count - i);
  Vec p = load_first(values + i, rest), m = load_first(first + i, rest), v = load_first(second + i, rest);
  adam_vector(f, step, load_first(gradients + i, rest), &p, &m, &v);
  store_first(values + i, p, rest);
  store_first(first + i, m, rest);
  store_first(second + i, v, rest);
}

// Whether four rows from `row` on are to be stepped with the bias corrections of `steps`.
EXTRAGS_INLINE bool four_alike(const AdamStep& a, int64_t row, int32_t steps) {
  const int32_t* s = a.steps + row;
  int32_t differ = (s[0] ^ steps) | (s[1] ^ steps) | (s[2] ^ steps) | (s[3] ^ steps);
  if (a.visible != nullptr) {
    uint32_t flags;
    memcpy(&flags, a.visible + row, 4);
    differ |= static_cast<int32_t>(flags ^ 0x01010101u);
  }
  return differ == 0;
}

constexpr int64_t kAdamRows = 1024;  // a task

static void adam_task(void* data, int task, int) {
  const AdamStep& a = *static_cast<const AdamStep*>(data);
  const int64_t end = (task + 1) * kAdamRows < a.rows ? (task + 1) * kAdamRows : a.rows;
  for (int64_t row = task * kAdamRows; row < end;) {
    if (a.visible != nullptr && a.visible[row] == 0) {
      ++row;
      continue;
    }
    const int32_t steps = a.steps[row];
    int64_t stop = row + 1;
    while (stop + 4 <= end && four_alike(a, stop, steps)) stop += 4;
    while (stop < end && a.steps[stop] == steps && (a.visible == nullptr || a.visible[stop] != 0)) ++stop;
    for (int k = 0; k < a.count; ++k) {
      const AdamArray& array = a.arrays[k];
      const auto run = array.rates == nullptr ? adam_run<false> : adam_run<true>;
      run(a, array, row, stop, a.bias1[steps], a.bias2[steps]);
    }
    row = stop;
  }
}

static void adam(const AdamStep* step) {
  parallel_for(static_cast<int>((step->rows + kAdamRows - 1) / kAdamRows), adam_task,
               const_cast<AdamStep*>(step));
}
