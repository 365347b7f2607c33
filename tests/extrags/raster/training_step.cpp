// One lit training step through the kernels' table alone, without Python: forward, loss, backward, query, Adam.
// Writes every result as float32; what the processor is does not change a bit of them.

#include <cstdint>
#include <cstdio>
#include <vector>

#include "kernels.h"

using namespace extrags;

namespace {

constexpr int kGaussians = 1500, kWidth = 97, kHeight = 61, kCoefficients = 16;
constexpr int64_t kQueries = 64;

// The same numbers everywhere: a generator of our own, integers only, scaled by a power of two.
struct Numbers {
  uint64_t state = 0x9E3779B97F4A7C15ull;
  float between(float low, float high) {
    state ^= state << 13;
    state ^= state >> 7;
    state ^= state << 17;
    const float unit = static_cast<float>(state >> 40) * 0x1p-24f;
    return low + (high - low) * unit;
  }
  std::vector<float> many(size_t count, float low, float high) {
    std::vector<float> values(count);
    for (float& value : values) value = between(low, high);
    return values;
  }
};

void write(std::FILE* file, const std::vector<float>& values) {
  std::fwrite(values.data(), sizeof(float), values.size(), file);
}

}  // namespace

int main(int, char** given) {
  const KernelTable& kernels = portable::table;
  set_num_threads(2);
  Numbers numbers;
  const size_t n = kGaussians, pixels = static_cast<size_t>(kWidth) * kHeight;
  std::vector<float> means(3 * n);
  for (size_t i = 0; i < n; ++i) {
    means[3 * i] = numbers.between(-6, 6);
    means[3 * i + 1] = numbers.between(-4, 4);
    means[3 * i + 2] = numbers.between(-0.5f, 12);  // some behind the camera
  }
  std::vector<float> quats = numbers.many(4 * n, -1, 1), scales = numbers.many(3 * n, 0.01f, 0.4f),
                     opacities = numbers.many(n, 0.01f, 0.99f),
                     sh = numbers.many(3 * kCoefficients * n, -0.5f, 0.5f);
  const Scene scene{kGaussians, means.data(), quats.data(), scales.data(), opacities.data(), sh.data(),
                    kCoefficients, 3, nullptr};

  View view{};
  view.width = kWidth;
  view.height = kHeight;
  view.near = 0.01f;
  view.camera.rotation[0] = view.camera.rotation[4] = view.camera.rotation[8] = 1;
  view.camera.translation[2] = 1.5f;
  view.camera.fx = view.camera.fy = 60;
  view.camera.cx = kWidth / 2.f;
  view.camera.cy = kHeight / 2.f;
  view.lit = true;
  view.light = {{1.1f, 0.9f, 1.f}, 0.5f, 1.8f, 0.3f, 0.6f, {0.2f, -0.1f, 0.f}, 0.4f, 0.3f, 0.2f, {0.03f, 0.01f, 0.02f}, 6.f};

  std::vector<float> rgb(3 * pixels), alpha(pixels), depth(pixels), median(pixels), means2d(2 * n), radius(n),
      most(n), sum(n);
  const Images images{rgb.data(), alpha.data(), depth.data(), median.data(), means2d.data(), radius.data(),
                      most.data(), sum.data(), nullptr};
  kernels.forward(&view, &scene, &images);

  const std::vector<float> target = numbers.many(3 * pixels, 0, 1), mask = numbers.many(pixels, 0, 1),
                           target_depth = numbers.many(pixels, 1, 12);
  std::vector<float> v_rgb(3 * pixels), v_depth(pixels);
  Buffer working{};
  const LossImages loss_images{kHeight, kWidth, rgb.data(), target.data(), mask.data(), nullptr, v_rgb.data(),
                               0.2f, 1e-4};
  const DepthImages depth_images{static_cast<int64_t>(pixels), depth.data(), alpha.data(), target_depth.data(),
                                 nullptr, v_depth.data(), 5.f, 0.1f};
  int64_t compared = 0;
  const double color_loss = kernels.loss(&loss_images, &working);
  const double depth_loss = kernels.inverse_depth(&depth_images, &working, &compared);

  std::vector<float> v_means(3 * n), v_quats(4 * n), v_scales(3 * n), v_opacities(n),
      v_sh(3 * kCoefficients * n), v_viewmat(16), v_light(kLightRow), v_means2d(2 * n), absolute(2 * n);
  const ImageGradients in{v_rgb.data(), nullptr, v_depth.data(), depth.data()};
  const SceneGradients out{false,          v_means.data(),   v_quats.data(), v_scales.data(),  v_opacities.data(),
                           v_sh.data(),    nullptr,          v_viewmat.data(), v_light.data(), v_means2d.data(),
                           absolute.data()};
  kernels.backward(&view, &scene, &in, &out);

  const std::vector<float> points = numbers.many(3 * kQueries, -2, 6);
  std::vector<float> transmittance(kQueries);
  kernels.query(&view, points.data(), kQueries, transmittance.data());

  std::vector<float> stepped = means, first(3 * n), second(3 * n);
  const std::vector<int32_t> steps(n, 1);
  const std::vector<float> bias1{0.f, 10.f}, bias2{0.f, 31.6227766f};
  const AdamArray array{stepped.data(), v_means.data(), first.data(), second.data(), 3, 1e-2f, nullptr};
  const AdamStep adam{&array, 1,    kGaussians, steps.data(), bias1.data(), bias2.data(), nullptr,
                      1e-15f, 0.9f, 0.999f,     0.1f,         0.001f};
  kernels.adam(&adam);

  std::FILE* file = std::fopen(given[1], "wb");
  if (file == nullptr) return 1;
  write(file, {static_cast<float>(color_loss), static_cast<float>(depth_loss), static_cast<float>(compared)});
  for (const auto* values : {&rgb, &alpha, &depth, &median, &means2d, &radius, &most, &sum, &v_rgb, &v_depth,
                             &v_means, &v_quats, &v_scales, &v_opacities, &v_sh, &v_viewmat, &v_light,
                             &v_means2d, &absolute, &transmittance, &stepped, &first, &second}) {
    write(file, *values);
  }
  return std::fclose(file);
}
