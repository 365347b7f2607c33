// Arrays and structs of arrays as Python hands them over. Included by module.cpp only.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstring>
#include <optional>
#include <stdexcept>
#include <string>

#include "kernels.h"

namespace nb = nanobind;
using namespace extrags;

namespace {

using In = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using Out = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using Counts = nb::ndarray<const int32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Doubles = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using Indices = nb::ndarray<int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Flags = nb::ndarray<const uint8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

template <class Array>
auto* data_or_null(const std::optional<Array>& array) {
  return array ? array->data() : nullptr;
}

void expect(bool ok, const char* what) {
  if (!ok) throw std::invalid_argument(std::string(what) + " has an unexpected size");
}

// The structs Python hands over. Their arrays live as long as they do, so that one made once serves every step;
// shapes are checked where a struct is made, sizes that two structs must share where they meet.

struct GaussianArrays {
  In means, quats, scales, opacities;
  std::optional<In> sh, colors;

  void check() const {
    const size_t n = count();
    expect(n < (size_t{1} << 28) && means.size() == 3 * n, "means");
    expect(quats.size() == 4 * n, "quats");
    expect(scales.size() == 3 * n, "scales");
    expect(opacities.size() == n, "opacities");
    expect(sh.has_value() != colors.has_value(), "sh or colors");
    expect(!sh || (sh->ndim() == 3 && sh->size() == 3 * n * sh->shape(1)), "sh");
    expect(!colors || colors->size() == 3 * n, "colors");
  }

  size_t count() const { return means.shape(0); }

  Scene scene(int degree) const {
    const int coefficients = sh ? static_cast<int>(sh->shape(1)) : 0;
    if (degree < 0 || degree > 3) {
      throw std::invalid_argument("degree is " + std::to_string(degree) + ", expected 0 to 3");
    }
    expect(!sh || (degree + 1) * (degree + 1) <= coefficients, "sh");
    return Scene{static_cast<int>(count()), means.data(), quats.data(), scales.data(), opacities.data(),
                 data_or_null(sh), coefficients, degree, data_or_null(colors)};
  }
};

// Copied from the arrays when it is made.
struct CameraSettings {
  Camera camera{};
  int width, height;
  float near;
  float background[3]{};
  bool lit;
  CameraLight light{};

  CameraSettings(const In& viewmat, const In& K, int width, int height, float near,
                 const std::optional<In>& background, const std::optional<In>& light,
                 const std::optional<In>& lens)
      : width(width), height(height), near(near), lit(light.has_value()) {
    expect(viewmat.size() == 16, "viewmat");
    expect(K.size() == 9, "K");
    expect(!background || background->size() == 3, "background");
    expect(!light || light->size() == kLightRow, "light");
    expect(!lens || lens->size() * sizeof(float) == sizeof(RadialLens), "lens");
    const float* v = viewmat.data();
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) camera.rotation[3 * i + j] = v[4 * i + j];
      camera.translation[i] = v[4 * i + 3];
    }
    const float* k = K.data();
    camera.fx = k[0];
    camera.fy = k[4];
    camera.cx = k[2];
    camera.cy = k[5];
    camera.bent = lens.has_value();
    if (lens) std::memcpy(&camera.lens, lens->data(), sizeof camera.lens);
    if (background) std::copy_n(background->data(), 3, this->background);
    if (light) std::memcpy(&this->light, light->data(), sizeof this->light);
  }

  void apply(View* view) const {
    view->width = width;
    view->height = height;
    view->near = near;
    view->camera = camera;
    std::copy_n(background, 3, view->background);
    view->lit = lit;
    if (lit) view->light = light;
  }
};

struct ImageArrays {
  Out rgb, alpha, depth, means2d, radius;
  std::optional<Out> median_depth, visibility_max, visibility_sum;
  std::optional<In> visibility_mask;

  void check(size_t pixels, size_t n) const {
    expect(rgb.size() == 3 * pixels, "rgb");
    expect(alpha.size() == pixels && depth.size() == pixels, "alpha or depth");
    expect(!median_depth || median_depth->size() == pixels, "median_depth");
    expect(means2d.size() == 2 * n && radius.size() == n, "means2d or radius");
    expect(visibility_max.has_value() == visibility_sum.has_value(), "visibility");
    expect(!visibility_max || (visibility_max->size() == n && visibility_sum->size() == n), "visibility");
    expect(!visibility_mask || visibility_mask->size() == pixels, "visibility_mask");
  }

  Images pointers() const {
    return Images{rgb.data(), alpha.data(), depth.data(), data_or_null(median_depth), means2d.data(),
                  radius.data(), data_or_null(visibility_max), data_or_null(visibility_sum),
                  data_or_null(visibility_mask)};
  }
};

struct ImageGradientArrays {
  std::optional<In> rgb, alpha, depth, depth_image;

  void check(size_t pixels) const {
    expect(!rgb || rgb->size() == 3 * pixels, "gradient of rgb");
    expect(!alpha || alpha->size() == pixels, "gradient of alpha");
    expect(!depth || (depth->size() == pixels && depth_image && depth_image->size() == pixels),
           "gradient of depth");
  }

  ImageGradients pointers() const {
    return ImageGradients{data_or_null(rgb), data_or_null(alpha), data_or_null(depth),
                          data_or_null(depth_image)};
  }
};

struct GaussianGradientArrays {
  std::optional<Out> means, quats, scales, opacities, sh, colors, means2d, absolute2d;

  void check(const GaussianArrays& of) const {
    const size_t n = of.count();
    expect(!means || means->size() == 3 * n, "gradient of means");
    expect(!quats || quats->size() == 4 * n, "gradient of quats");
    expect(!scales || scales->size() == 3 * n, "gradient of scales");
    expect(!opacities || opacities->size() == n, "gradient of opacities");
    expect(!sh || (of.sh && sh->size() == of.sh->size()), "gradient of sh");
    expect(!colors || colors->size() == 3 * n, "gradient of colors");
    expect(!means2d || means2d->size() == 2 * n, "gradient of means2d");
    expect(!absolute2d || absolute2d->size() == 2 * n, "absolute gradient of means2d");
  }
};

struct CameraGradientArrays {
  std::optional<Out> viewmat, light;

  void check(bool lit) const {
    expect(!viewmat || viewmat->size() == 16, "gradient of viewmat");
    expect(!light || (lit && light->size() == kLightRow), "gradient of light");
  }
};

}  // namespace
