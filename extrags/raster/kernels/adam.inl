// Adam over the rows of one parameter; the rule is in adam.py.

struct AdamContext {
  const AdamRows* rows;
  int64_t per_task;
};

// Steps `count` consecutive floats that share their bias corrections.
static void adam_run(const AdamRows& a, int64_t begin, int64_t count, float rate, float root_scale) {
  const Vec beta1(a.beta1), beta2(a.beta2), rest1(a.rest1), rest2(a.rest2);
  const Vec step(rate), scale(root_scale), eps(a.eps), most(3e38f);
  for (int64_t i = begin; i < begin + count; i += 16) {
    const int lanes = begin + count - i < 16 ? static_cast<int>(begin + count - i) : 16;
    const bool whole = lanes == 16;
    const Vec g = whole ? load(a.gradients + i) : load_first(a.gradients + i, lanes);
    const Vec m0 = whole ? load(a.first + i) : load_first(a.first + i, lanes);
    const Vec v0 = whole ? load(a.second + i) : load_first(a.second + i, lanes);
    const Vec p0 = whole ? load(a.values + i) : load_first(a.values + i, lanes);
    const Vec m = fma(beta1, m0, rest1 * g);
    const Vec v = min(fma(beta2, v0, rest2 * g * g), most);
    const Vec p = p0 - step * m / fma(sqrt(v), scale, eps);
    if (whole) {
      store(a.first + i, m);
      store(a.second + i, v);
      store(a.values + i, p);
    } else {
      store_first(a.first + i, m, lanes);
      store_first(a.second + i, v, lanes);
      store_first(a.values + i, p, lanes);
    }
  }
}

static void adam_task(void* data, int task, int) {
  const AdamContext& c = *static_cast<AdamContext*>(data);
  const AdamRows& a = *c.rows;
  const int64_t end = (task + 1) * c.per_task < a.rows ? (task + 1) * c.per_task : a.rows;
  for (int64_t row = task * c.per_task; row < end;) {
    if (a.visible != nullptr && a.visible[row] == 0) {
      ++row;
      continue;
    }
    const int32_t steps = a.steps[row];
    int64_t stop = row + 1;
    while (stop < end && a.steps[stop] == steps && (a.visible == nullptr || a.visible[stop] != 0)) ++stop;
    adam_run(a, row * a.columns, (stop - row) * a.columns, a.rate * a.bias1[steps], a.bias2[steps]);
    row = stop;
  }
}

static void adam(const AdamRows* rows) {
  AdamContext c;
  c.rows = rows;
  // Some ten thousand floats a task
  c.per_task = 1 + 12288 / rows->columns;
  parallel_for(static_cast<int>((rows->rows + c.per_task - 1) / c.per_task), adam_task, &c);
}
