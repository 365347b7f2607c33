// L1 + SSIM with its gradient, streaming over rows; the formula is in loss.py.
//
// A row is taken as 3 width floats: horizontal taps lie three floats apart, no channel is split off. Row y
// passes three stages as the rows below it arrive: blurred horizontally (four maps of image and target),
// blurred vertically into SSIM and its derivatives (three maps, blurred horizontally again), and blurred
// vertically into the gradient. Every row's numbers depend on its own inputs only, so the image may be cut
// into any number of bands. The vertical passes take several rows together: these share most of the rows they
// read, which lie in the second cache.

constexpr int kTaps = 5;        // on each side
constexpr int kPad = 32;        // floats beside a row; at least 3 kTaps, and a vector more on the right
constexpr int kLossRows = 4;    // taken together by the vertical passes
constexpr int kMoments = 4;     // maps whose window means SSIM needs
constexpr int kRing = 16;       // rows kept of each map; at least 2 kTaps + kLossRows
constexpr float kSsimC1 = 1e-4f, kSsimC2 = 9e-4f;

struct LossContext {
  const LossImages* images;
  float taps[kTaps + 1];
  int bands, row_floats, padded;
  float* working;      // per band
  size_t per_band;     // floats
  double* row_losses;  // [2, height]: L1, SSIM
};

EXTRAGS_INLINE Vec blur_across(const float* p, const Vec* taps) {
  Vec total = load(p) * taps[0];
  for (int k = 1; k <= kTaps; ++k) total = fma(load(p - 3 * k) + load(p + 3 * k), taps[k], total);
  return total;
}

// Blurs kRows rows of kMaps maps vertically: out[row][map]. `rows` starts kTaps above the first. Maps are stored
// side by side, a vector of each in turn, so that one address per row serves all of them.
template <int kRows, int kMaps>
EXTRAGS_INLINE void blur_down(const float* const* rows, int i, const Vec* taps, Vec (*out)[kMaps]) {
  const size_t at = static_cast<size_t>(i) * kMaps;
  for (int m = 0; m < kMaps; ++m) {
    Vec lines[kRows + 2 * kTaps];
    for (int k = 0; k < kRows + 2 * kTaps; ++k) lines[k] = load(rows[k] + at + 16 * m);
    for (int j = 0; j < kRows; ++j) {
      const Vec* middle = lines + j + kTaps;
      Vec total = middle[0] * taps[0];
      for (int k = 1; k <= kTaps; ++k) total = fma(middle[-k] + middle[k], taps[k], total);
      out[j][m] = total;
    }
  }
}

// Blurs x, y, xx + yy and xy of one row horizontally: SSIM needs the sum of the two variances alone.
static void blur_products(const float* x, const float* y, float* maps, int n, const Vec* taps) {
  for (int i = 0; i < n; i += 16, maps += kMoments * 16) {
    const Vec x0 = load(x + i), y0 = load(y + i);
    Vec sx = x0 * taps[0], sy = y0 * taps[0];
    Vec squares = fma(sx, x0, sy * y0), sxy = sx * y0;
    for (int k = 1; k <= kTaps; ++k) {
      const Vec xl = load(x + i - 3 * k), xr = load(x + i + 3 * k);
      const Vec yl = load(y + i - 3 * k), yr = load(y + i + 3 * k);
      sx = fma(xl + xr, taps[k], sx);
      sy = fma(yl + yr, taps[k], sy);
      squares = fma(fma(xl, xl, xr * xr) + fma(yl, yl, yr * yr), taps[k], squares);
      sxy = fma(fma(xl, yl, xr * yr), taps[k], sxy);
    }
    store(maps, sx);
    store(maps + 16, sy);
    store(maps + 32, squares);
    store(maps + 48, sxy);
  }
}

static void expand_mask(const float* mask, int width, int y, float* weights) {
  for (int x = 0; x < width; ++x) {
    const float m = mask == nullptr ? 1.f : mask[static_cast<size_t>(y) * width + x];
    weights[3 * x] = weights[3 * x + 1] = weights[3 * x + 2] = m;
  }
}

// SSIM of kRows rows and its derivatives, weighted; per row the weighted sum of 1 - SSIM.
template <int kRows>
static void ssim_rows(const float* const* rows, const float* const* weights, float* const (*derivatives)[3], int n,
                      const Vec* taps, double* losses) {
  const Vec one(1.f), two(2.f), c1(kSsimC1), c2(kSsimC2), zero(0.f);
  Vec loss[kRows];
  for (int j = 0; j < kRows; ++j) loss[j] = zero;
  for (int i = 0; i < n; i += 16) {
    const int lanes = n - i < 16 ? n - i : 16;
    Vec means[kRows][kMoments];
    blur_down<kRows, kMoments>(rows, i, taps, means);
    for (int j = 0; j < kRows; ++j) {
      const Vec mx = means[j][0], my = means[j][1], squares = means[j][2], xy = means[j][3];
      const Vec mxx = mx * mx, myy = my * my, mxy = mx * my;
      // Rounding may leave the sum of variances below zero.
      const Vec m_squares = mxx + myy, variances = max(squares - m_squares, zero), vxy = xy - mxy;
      const Vec a1 = fma(two, mxy, c1), a2 = fma(two, vxy, c2);
      const Vec b1 = m_squares + c1, b2 = variances + c2;
      const Vec inverse = one / (b1 * b2), inverse1 = b2 * inverse, inverse2 = b1 * inverse;
      const Vec ssim = a1 * a2 * inverse;
      const Vec weight = load_first(weights[j] + i, lanes);
      loss[j] = loss[j] + weight * (one - ssim);
      const Vec d_mean = two * fma(my * (a2 - a1), inverse, mx * ssim * (inverse2 - inverse1));
      store_first(derivatives[j][0] + i, weight * d_mean, lanes);
      store_first(derivatives[j][1] + i, weight * negated(ssim * inverse2), lanes);
      store_first(derivatives[j][2] + i, weight * two * a1 * inverse, lanes);
    }
  }
  for (int j = 0; j < kRows; ++j) losses[j] = static_cast<double>(sum(loss[j]));
}

// Gradient of kRows rows from `y` on; per row the weighted sum of |x - y|.
template <int kRows>
static void gradient_rows(const LossImages& images, int y, const float* const* rows, const float* const* weights,
                          int n, const Vec* taps, double* losses) {
  const float scale = static_cast<float>(images.scale);
  const Vec l1_scale((1 - images.dssim_weight) * scale), ssim_scale(-0.5f * images.dssim_weight * scale);
  const Vec zero(0.f), one(1.f), two(2.f);
  Vec loss[kRows];
  for (int j = 0; j < kRows; ++j) loss[j] = zero;
  for (int i = 0; i < n; i += 16) {
    const int lanes = n - i < 16 ? n - i : 16;
    Vec d[kRows][3];  // of the mean, of the mean square, of the mean product
    blur_down<kRows, 3>(rows, i, taps, d);
    for (int j = 0; j < kRows; ++j) {
      const size_t at = static_cast<size_t>(y + j) * n + i;
      const Vec x = load_first(images.image + at, lanes);
      const Vec target = load_first(images.target + at, lanes);
      const Vec weight = load_first(weights[j] + i, lanes);
      const Vec difference = x - target;
      loss[j] = fma(weight, abs(difference), loss[j]);
      const Vec sign = keep(gt(difference, zero), one) - keep(gt(zero, difference), one);
      const Vec of_ssim = fma(two * x, d[j][1], fma(target, d[j][2], d[j][0]));
      store_first(images.gradient + at, fma(l1_scale, weight * sign, ssim_scale * of_ssim), lanes);
    }
  }
  for (int j = 0; j < kRows; ++j) losses[j] = static_cast<double>(sum(loss[j]));
}

// One band's rows of working memory, and the state that its two vertical passes share
struct LossBand {
  const LossContext* context;
  const LossImages* images;
  int begin, end;  // rows of the gradient
  Vec taps[kTaps + 1];
  float *x, *y;  // rows with zeros on both sides, as the next two
  float* weights[kLossRows];
  float* derivatives[kLossRows][3];
  float *products, *gradients;  // rings
  const float* zeros;           // as long as a row of either

  size_t padded() const { return static_cast<size_t>(context->padded); }
  float* product_row(int row) const { return products + static_cast<size_t>(row % kRing) * kMoments * padded(); }
  float* gradient_row(int row) const { return gradients + static_cast<size_t>(row % kRing) * 3 * padded(); }
};

template <int kRows>
static void ssim_pass(const LossBand& b, int first) {
  const LossContext& c = *b.context;
  const LossImages& images = *b.images;
  const float* const mask = images.ssim_mask != nullptr ? images.ssim_mask : images.mask;
  const float* rows[kRows + 2 * kTaps];
  for (int k = 0; k < kRows + 2 * kTaps; ++k) {
    const int at = first - kTaps + k;
    rows[k] = at < 0 || at >= images.height ? b.zeros : b.product_row(at);
  }
  if (mask != nullptr) {
    for (int j = 0; j < kRows; ++j) expand_mask(mask, images.width, first + j, b.weights[j]);
  }
  double losses[kRows];
  ssim_rows<kRows>(rows, b.weights, b.derivatives, c.row_floats, b.taps, losses);
  for (int j = 0; j < kRows; ++j) {
    const int row = first + j;
    if (row >= b.begin && row < b.end) c.row_losses[images.height + row] = losses[j];
    float* to = b.gradient_row(row);
    for (int i = 0; i < c.row_floats; i += 16, to += 3 * 16) {
      for (int m = 0; m < 3; ++m) store(to + 16 * m, blur_across(b.derivatives[j][m] + i, b.taps));
    }
  }
}

template <int kRows>
static void gradient_pass(const LossBand& b, int first) {
  const LossContext& c = *b.context;
  const LossImages& images = *b.images;
  const float* rows[kRows + 2 * kTaps];
  for (int k = 0; k < kRows + 2 * kTaps; ++k) {
    const int at = first - kTaps + k;
    rows[k] = at < 0 || at >= images.height ? b.zeros : b.gradient_row(at);
  }
  if (images.mask != nullptr || images.ssim_mask != nullptr) {
    for (int j = 0; j < kRows; ++j) expand_mask(images.mask, images.width, first + j, b.weights[j]);
  }
  gradient_rows<kRows>(images, first, rows, b.weights, c.row_floats, b.taps, c.row_losses + first);
}

static void loss_band(void* data, int band, int) {
  const LossContext& c = *static_cast<LossContext*>(data);
  const LossImages& images = *c.images;
  const int height = images.height, n = c.row_floats;
  LossBand b;
  b.context = &c;
  b.images = &images;
  b.begin = static_cast<int>(static_cast<int64_t>(height) * band / c.bands);
  b.end = static_cast<int>(static_cast<int64_t>(height) * (band + 1) / c.bands);
  for (int k = 0; k <= kTaps; ++k) b.taps[k] = Vec(c.taps[k]);
  float* next = c.working + c.per_band * band;
  memset(next, 0, sizeof(float) * c.per_band);
  const auto take_row = [&] {
    float* row = next + kPad;
    next += c.padded;
    return row;
  };
  b.x = take_row();
  b.y = take_row();
  for (int j = 0; j < kLossRows; ++j) {
    b.weights[j] = take_row();
    for (float*& row : b.derivatives[j]) row = take_row();
  }
  b.products = next;
  b.gradients = b.products + static_cast<size_t>(kRing) * kMoments * c.padded;
  b.zeros = b.gradients + static_cast<size_t>(kRing) * 3 * c.padded;
  if (images.ssim_mask == nullptr && images.mask == nullptr) {
    for (float* weights : b.weights) expand_mask(nullptr, images.width, 0, weights);
  }
  const int low = b.begin - kTaps > 0 ? b.begin - kTaps : 0;
  const int high = b.end + kTaps < height ? b.end + kTaps : height;
  for (int row = low - kTaps > 0 ? low - kTaps : 0; row < b.end + 2 * kTaps; row += kLossRows) {
    for (int at = row; at < row + kLossRows && at < height; ++at) {
      memcpy(b.x, images.image + static_cast<size_t>(at) * n, sizeof(float) * n);
      memcpy(b.y, images.target + static_cast<size_t>(at) * n, sizeof(float) * n);
      blur_products(b.x, b.y, b.product_row(at), n, b.taps);
    }
    const int middle = row - kTaps;
    if (middle >= low && middle + kLossRows <= high) {
      ssim_pass<kLossRows>(b, middle);
    } else {
      for (int at = middle; at < middle + kLossRows; ++at) {
        if (at >= low && at < high) ssim_pass<1>(b, at);
      }
    }
    const int last = row - 2 * kTaps;
    if (last >= b.begin && last + kLossRows <= b.end) {
      gradient_pass<kLossRows>(b, last);
    } else {
      for (int at = last; at < last + kLossRows; ++at) {
        if (at >= b.begin && at < b.end) gradient_pass<1>(b, at);
      }
    }
  }
}

// Returns `scale` times the weighted sums over this image.
static double loss(const LossImages* images, Buffer* working) {
  LossContext c;
  c.images = images;
  double taps[kTaps + 1], total = 0;
  for (int k = 0; k <= kTaps; ++k) {
    taps[k] = __builtin_exp(-k * k / (2 * 1.5 * 1.5));
    total += k == 0 ? taps[k] : 2 * taps[k];
  }
  for (int k = 0; k <= kTaps; ++k) c.taps[k] = static_cast<float>(taps[k] / total);
  const int most = images->height / 32 > 1 ? images->height / 32 : 1;
  c.bands = num_threads() < most ? num_threads() : most;
  c.row_floats = 3 * images->width;
  c.padded = (c.row_floats + 15) / 16 * 16 + 2 * kPad;
  c.per_band = static_cast<size_t>(c.padded) * (2 + 4 * kLossRows + (kMoments + 3) * kRing + kMoments);
  const size_t losses = sizeof(double) * 2 * images->height;
  const size_t head = (losses + 63) / 64 * 64;
  reserve(working, head + sizeof(float) * c.per_band * c.bands);
  c.row_losses = static_cast<double*>(working->data);
  c.working = reinterpret_cast<float*>(static_cast<char*>(working->data) + head);
  parallel_for(c.bands, loss_band, &c);
  double l1 = 0, dissimilarity = 0;
  for (int y = 0; y < images->height; ++y) {
    l1 += c.row_losses[y];
    dissimilarity += c.row_losses[images->height + y];
  }
  return images->scale * ((1 - static_cast<double>(images->dssim_weight)) * l1 +
                          0.5 * static_cast<double>(images->dssim_weight) * dissimilarity);
}
