// L1 + SSIM with its gradient, streaming over rows; the formula is in loss.py.
//
// A row is taken as 3 width floats: horizontal taps lie three floats apart, no channel is split off. Row y
// passes three stages as the rows below it arrive: blurred horizontally (five maps of image and target),
// blurred vertically into SSIM and its derivatives (three maps, blurred horizontally again), and blurred
// vertically into the gradient. Every row's numbers depend on its own inputs only, so the image may be cut
// into any number of bands.

constexpr int kTaps = 5;        // on each side
constexpr int kPad = 32;        // floats beside a row; at least 3 kTaps, and a vector more on the right
constexpr int kRing = 16;       // rows kept of each map; at least 2 kTaps + 1
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

// Maps are stored side by side, a vector of each in turn, so that one address per row serves all of them.
template <int kMaps>
EXTRAGS_INLINE void blur_down(const float* const* rows, int i, const Vec* taps, Vec* out) {
  const size_t at = static_cast<size_t>(i) * kMaps;
  for (int m = 0; m < kMaps; ++m) out[m] = load(rows[kTaps] + at + 16 * m) * taps[0];
  for (int k = 1; k <= kTaps; ++k) {
    const float *above = rows[kTaps - k] + at, *below = rows[kTaps + k] + at;
    for (int m = 0; m < kMaps; ++m) out[m] = fma(load(above + 16 * m) + load(below + 16 * m), taps[k], out[m]);
  }
}

// Blurs x, y, xx, yy and xy of one row horizontally.
static void blur_products(const float* x, const float* y, float* maps, int n, const Vec* taps) {
  for (int i = 0; i < n; i += 16, maps += 5 * 16) {
    const Vec x0 = load(x + i), y0 = load(y + i);
    Vec sx = x0 * taps[0], sy = y0 * taps[0];
    Vec sxx = sx * x0, syy = sy * y0, sxy = sx * y0;
    for (int k = 1; k <= kTaps; ++k) {
      const Vec xl = load(x + i - 3 * k), xr = load(x + i + 3 * k);
      const Vec yl = load(y + i - 3 * k), yr = load(y + i + 3 * k);
      sx = fma(xl + xr, taps[k], sx);
      sy = fma(yl + yr, taps[k], sy);
      sxx = fma(fma(xl, xl, xr * xr), taps[k], sxx);
      syy = fma(fma(yl, yl, yr * yr), taps[k], syy);
      sxy = fma(fma(xl, yl, xr * yr), taps[k], sxy);
    }
    store(maps, sx);
    store(maps + 16, sy);
    store(maps + 32, sxx);
    store(maps + 48, syy);
    store(maps + 64, sxy);
  }
}

static void expand_mask(const float* mask, int width, int y, float* weights) {
  for (int x = 0; x < width; ++x) {
    const float m = mask == nullptr ? 1.f : mask[static_cast<size_t>(y) * width + x];
    weights[3 * x] = weights[3 * x + 1] = weights[3 * x + 2] = m;
  }
}

// SSIM of one row and its derivatives, weighted; returns the weighted sum of 1 - SSIM.
static float ssim_row(const float* const* rows, const float* weights, float* const* derivatives,
                      int n, const Vec* taps) {
  const Vec one(1.f), two(2.f), c1(kSsimC1), c2(kSsimC2), zero(0.f);
  Vec loss(0.f);
  for (int i = 0; i < n; i += 16) {
    const int lanes = n - i < 16 ? n - i : 16;
    Vec mean[5];
    blur_down<5>(rows, i, taps, mean);
    const Vec mx = mean[0], my = mean[1], xx = mean[2], yy = mean[3], xy = mean[4];
    const Vec mxx = mx * mx, myy = my * my, mxy = mx * my;
    // Rounding may leave a variance below zero.
    const Vec vxx = max(xx - mxx, zero), vyy = max(yy - myy, zero), vxy = xy - mxy;
    const Vec a1 = fma(two, mxy, c1), a2 = fma(two, vxy, c2);
    const Vec b1 = mxx + myy + c1, b2 = vxx + vyy + c2;
    const Vec inverse = one / (b1 * b2), inverse1 = b2 * inverse, inverse2 = b1 * inverse;
    const Vec ssim = a1 * a2 * inverse;
    const Vec weight = load_first(weights + i, lanes);
    loss = loss + weight * (one - ssim);
    const Vec d_mean = two * fma(my * (a2 - a1), inverse, mx * ssim * (inverse2 - inverse1));
    store_first(derivatives[0] + i, weight * d_mean, lanes);
    store_first(derivatives[1] + i, weight * negated(ssim * inverse2), lanes);
    store_first(derivatives[2] + i, weight * two * a1 * inverse, lanes);
  }
  return sum(loss);
}

// Gradient of one row; returns the weighted sum of |x - y|.
static float gradient_row(const LossImages& images, int y, const float* const* rows, const float* weights,
                          int n, const Vec* taps) {
  const size_t offset = static_cast<size_t>(y) * n;
  const float scale = static_cast<float>(images.scale);
  const Vec l1_scale((1 - images.dssim_weight) * scale), ssim_scale(-0.5f * images.dssim_weight * scale);
  const Vec zero(0.f), one(1.f), two(2.f);
  Vec loss(0.f);
  for (int i = 0; i < n; i += 16) {
    const int lanes = n - i < 16 ? n - i : 16;
    const Vec x = load_first(images.image + offset + i, lanes);
    const Vec target = load_first(images.target + offset + i, lanes);
    const Vec weight = load_first(weights + i, lanes);
    Vec d[3];  // of the mean, of the mean square, of the mean product
    blur_down<3>(rows, i, taps, d);
    const Vec difference = x - target;
    loss = fma(weight, abs(difference), loss);
    const Vec sign = keep(gt(difference, zero), one) - keep(gt(zero, difference), one);
    const Vec of_ssim = fma(two * x, d[1], fma(target, d[2], d[0]));
    store_first(images.gradient + offset + i, fma(l1_scale, weight * sign, ssim_scale * of_ssim), lanes);
  }
  return sum(loss);
}

static void loss_band(void* data, int band, int) {
  const LossContext& c = *static_cast<LossContext*>(data);
  const LossImages& images = *c.images;
  const int height = images.height, n = c.row_floats;
  const int begin = static_cast<int>(static_cast<int64_t>(height) * band / c.bands);
  const int end = static_cast<int>(static_cast<int64_t>(height) * (band + 1) / c.bands);
  Vec taps[kTaps + 1];
  for (int k = 0; k <= kTaps; ++k) taps[k] = Vec(c.taps[k]);
  float* next = c.working + c.per_band * band;
  memset(next, 0, sizeof(float) * c.per_band);
  // Rows with zeros on both sides
  float* row_at[6];
  for (float*& row : row_at) {
    row = next + kPad;
    next += c.padded;
  }
  float *x = row_at[0], *y = row_at[1], *weights = row_at[2];
  float* const derivatives[3] = {row_at[3], row_at[4], row_at[5]};
  float* const products = next;
  float* const gradients = products + static_cast<size_t>(kRing) * 5 * c.padded;
  // A row of zeros for each kind of map
  const float* const no_products = gradients + static_cast<size_t>(kRing) * 3 * c.padded;
  const float* rows[2 * kTaps + 1];
  const float* const ssim_mask = images.ssim_mask != nullptr ? images.ssim_mask : images.mask;
  if (ssim_mask == nullptr) expand_mask(nullptr, images.width, 0, weights);
  const int first = begin - 2 * kTaps > 0 ? begin - 2 * kTaps : 0;
  for (int row = first; row < end + 2 * kTaps; ++row) {
    if (row < height) {
      memcpy(x, images.image + static_cast<size_t>(row) * n, sizeof(float) * n);
      memcpy(y, images.target + static_cast<size_t>(row) * n, sizeof(float) * n);
      blur_products(x, y, products + static_cast<size_t>(row % kRing) * 5 * c.padded, n, taps);
    }
    const int middle = row - kTaps;
    if (middle >= 0 && middle < height && middle >= begin - kTaps && middle < end + kTaps) {
      for (int k = -kTaps; k <= kTaps; ++k) {
        const int at = middle + k;
        rows[k + kTaps] = at < 0 || at >= height
                              ? no_products
                              : products + static_cast<size_t>(at % kRing) * 5 * c.padded;
      }
      if (ssim_mask != nullptr) expand_mask(ssim_mask, images.width, middle, weights);
      const float loss = ssim_row(rows, weights, derivatives, n, taps);
      if (middle >= begin && middle < end) c.row_losses[height + middle] = loss;
      float* to = gradients + static_cast<size_t>(middle % kRing) * 3 * c.padded;
      for (int i = 0; i < n; i += 16, to += 3 * 16) {
        for (int m = 0; m < 3; ++m) store(to + 16 * m, blur_across(derivatives[m] + i, taps));
      }
    }
    const int last = row - 2 * kTaps;
    if (last >= begin && last < end) {
      for (int k = -kTaps; k <= kTaps; ++k) {
        const int at = last + k;
        rows[k + kTaps] = at < 0 || at >= height
                              ? no_products
                              : gradients + static_cast<size_t>(at % kRing) * 3 * c.padded;
      }
      if (ssim_mask != nullptr) expand_mask(images.mask, images.width, last, weights);
      c.row_losses[last] = gradient_row(images, last, rows, weights, n, taps);
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
  c.per_band = static_cast<size_t>(c.padded) * (6 + 8 * kRing + 5);
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
