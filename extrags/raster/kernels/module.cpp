// Python bindings: shapes are checked in Python, lifetimes are held here, the GIL is released while kernels run.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/variant.h>
#include <nanobind/stl/vector.h>

#include <pthread.h>

#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <mutex>
#include <optional>
#include <stdexcept>
#include <string>
#include <tuple>
#include <variant>
#include <vector>

#include "arrays.h"
#include "kernels.h"
#include "march.h"


namespace {

// The tables this processor can run, the fastest first.
std::vector<const KernelTable*> usable_tables() {
  std::vector<const KernelTable*> tables;
#if defined(__x86_64__)
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512bw") &&
      __builtin_cpu_supports("avx512cd") && __builtin_cpu_supports("fma")) {
    tables.push_back(&avx512::table);
  }
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
      __builtin_cpu_supports("bmi") && __builtin_cpu_supports("bmi2")) {
    tables.push_back(&avx2::table);
  }
#endif
  tables.push_back(&portable::table);
  return tables;
}

// `source` begins the message: where a name that is not usable comes from.
const KernelTable* find_table(const std::string& name, const std::string& source = "") {
  std::string names;
  for (const KernelTable* table : usable_tables()) {
    if (name == table->name) return table;
    names += names.empty() ? table->name : std::string(", ") + table->name;
  }
  throw std::invalid_argument(source + "instruction set '" + name + "' is not usable here, expected one of " +
                              names);
}

const KernelTable* initial_table() {
  const char* wanted = std::getenv("EXTRAGS_ISA");
  return wanted != nullptr && *wanted != '\0' ? find_table(wanted, "EXTRAGS_ISA: ") : usable_tables().front();
}

const KernelTable*& active() {
  static const KernelTable* table = initial_table();
  return table;
}

struct ViewDeleter {
  void operator()(View* view) const {
    Buffer* all[] = {&view->records, &view->rects, &view->depths, &view->pair_starts, &view->counts, &view->chunk_pairs,
                     &view->tile_starts, &view->keys, &view->locals, &view->block_starts, &view->block_kept,
                     &view->finals, &view->pair_rows, &view->partials, &view->query};
    for (Buffer* buffer : all) release(buffer);
    for (int tile = 0; tile < view->tile_entries_count; ++tile) {
      release(static_cast<Buffer*>(view->tile_entries.data) + tile);
    }
    release(&view->tile_entries);
    for (Buffer& buffer : view->scratch) release(&buffer);
    delete view;
  }
};
using ViewPointer = std::unique_ptr<View, ViewDeleter>;

// Views whose memory waits for the next call: page faults cost more than the projection.
class SpareViews {
 public:
  ViewPointer take() {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (spare_.empty()) return ViewPointer(new View{});
    ViewPointer view = std::move(spare_.back());
    spare_.pop_back();
    return view;
  }
  void give_back(ViewPointer view) {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (spare_.size() < kMost) spare_.push_back(std::move(view));
  }

 private:
  static constexpr size_t kMost = 4;
  std::mutex mutex_;
  std::vector<ViewPointer> spare_;
};

SpareViews& spare_views() {
  static SpareViews* const views = new SpareViews;  // outlives all frames
  return *views;
}

// What one camera's forward pass left.
struct Frame {
  ViewPointer view = spare_views().take();
  const KernelTable* kernels = active();
  int degree = 0;
  Frame() = default;
  Frame(Frame&&) = default;
  ~Frame() {
    if (view) spare_views().give_back(std::move(view));
  }
};

std::unique_ptr<Frame> render(const GaussianArrays& gaussians, const CameraSettings& camera,
                              const ImageArrays& images, int degree, bool check) {
  const Scene scene = gaussians.scene(degree);
  expect(camera.width > 0 && camera.width <= 32768 && camera.height > 0 && camera.height <= 32768, "an image");
  images.check(static_cast<size_t>(camera.width) * static_cast<size_t>(camera.height), gaussians.count());
  auto frame = std::make_unique<Frame>();
  frame->degree = degree;
  camera.apply(frame->view.get());
  const Images out = images.pointers();
  nb::gil_scoped_release release_gil;
  frame->view->check = check;
  frame->kernels->forward(frame->view.get(), &scene, &out);
  if (!frame->view->finite) return nullptr;
  return frame;
}

void frame_backward(Frame& frame, const GaussianArrays& gaussians, const ImageGradientArrays& images,
                    const GaussianGradientArrays& gradients, const CameraGradientArrays& camera, bool add) {
  const Scene scene = gaussians.scene(frame.degree);
  View* view = frame.view.get();
  expect(view->n == scene.n, "means");
  images.check(static_cast<size_t>(view->width) * static_cast<size_t>(view->height));
  gradients.check(gaussians);
  camera.check(view->lit);
  const ImageGradients in = images.pointers();
  const SceneGradients out{add,
                           data_or_null(gradients.means),
                           data_or_null(gradients.quats),
                           data_or_null(gradients.scales),
                           data_or_null(gradients.opacities),
                           data_or_null(gradients.sh),
                           data_or_null(gradients.colors),
                           data_or_null(camera.viewmat),
                           data_or_null(camera.light),
                           data_or_null(gradients.means2d),
                           data_or_null(gradients.absolute2d)};
  nb::gil_scoped_release release_gil;
  frame.kernels->backward(view, &scene, &in, &out);
}

void frame_query(Frame& frame, const In& points, Out transmittance) {
  expect(points.size() == 3 * transmittance.size() && points.size() < (size_t{1} << 31), "points");
  nb::gil_scoped_release release_gil;
  frame.kernels->query(frame.view.get(), points.data(), static_cast<int64_t>(transmittance.size()),
                       transmittance.data());
}

// How many (Gaussian, block) entries some pixel composited or ended at
int64_t frame_entries(const Frame& frame) {
  const View* view = frame.view.get();
  const uint32_t* kept = static_cast<const uint32_t*>(view->block_kept.data);
  int64_t total = 0;
  for (int tile = 0; tile < view->tiles_x * view->tiles_y; ++tile) {
    for (int block = 0; block < kTileBlocks * kTileBlocks; ++block, ++kept) {
      const int x = tile % view->tiles_x * kTilePx + block % kTileBlocks * 4;
      const int y = tile / view->tiles_x * kTilePx + block / kTileBlocks * 4;
      if (x < view->width && y < view->height) total += *kept;
    }
  }
  return total;
}

std::vector<double> frame_seconds(const Frame& frame) {
  return std::vector<double>(frame.view->seconds, frame.view->seconds + 4);
}

// Working memory of the calling thread
Buffer* thread_working() {
  struct Working {
    Buffer buffer{nullptr, 0};
    ~Working() { release(&buffer); }
  };
  thread_local Working working;
  return &working.buffer;
}

double l1_ssim(const In& image, const In& target, std::optional<In> mask, Out gradient, float dssim_weight,
               double scale, std::optional<In> ssim_mask) {
  expect(image.ndim() == 3 && image.shape(2) == 3, "image");
  const size_t height = image.shape(0), width = image.shape(1);
  expect(height > 0 && width > 0, "image");
  expect(target.size() == image.size(), "target");
  expect(gradient.size() == image.size(), "gradient");
  expect(!mask || mask->size() == height * width, "mask");
  expect(!ssim_mask || ssim_mask->size() == height * width, "ssim_mask");
  const LossImages images{static_cast<int>(height), static_cast<int>(width),  image.data(),
                          target.data(),            data_or_null(mask),       data_or_null(ssim_mask),
                          gradient.data(),          dssim_weight,             scale};
  nb::gil_scoped_release release_gil;
  return active()->loss(&images, thread_working());
}

std::tuple<double, int64_t> inverse_depth(const In& depth, const In& alpha, const In& target, Out gradient,
                                          float scale, float weight, std::optional<In> confidence) {
  const size_t pixels = depth.size();
  expect(!confidence || confidence->size() == pixels, "a confidence image");
  expect(alpha.size() == pixels && target.size() == pixels && gradient.size() == pixels, "a depth image");
  const DepthImages images{static_cast<int64_t>(pixels), depth.data(), alpha.data(), target.data(),
                           confidence ? confidence->data() : nullptr, gradient.data(), scale, weight};
  nb::gil_scoped_release release_gil;
  int64_t compared = 0;
  const double loss = active()->inverse_depth(&images, thread_working(), &compared);
  return {loss, compared};
}

// Working memory of stereo, one block per thread of the pool; calls take turns.
struct StereoMemory {
  std::mutex mutex;
  Buffer volume{};
  Buffer scratch[kMaxThreads]{};
};

StereoMemory* stereo_memory = new StereoMemory;  // outlives all calls

// A thread that a forked child does not have may have held the mutex, and left the buffers half changed.
void renew_stereo_memory() { stereo_memory = new StereoMemory; }

// Brightness, mask, 3 x 3 matrix from pixels of the reference, offset
using SourceTuple = std::tuple<In, In, In, In>;

void march_rays(const In& reach, const Doubles& start, const Doubles& directions, Indices entered) {
  expect(reach.ndim() == 3 && reach.shape(0) == reach.shape(1) && reach.shape(1) == reach.shape(2), "reach");
  expect(start.size() == 3, "start");
  expect(directions.ndim() == 2 && directions.shape(1) == 3, "directions");
  expect(entered.shape(0) == directions.shape(0), "entered");
  nb::gil_scoped_release release_gil;
  march(reach.data(), static_cast<int64_t>(reach.shape(0)), start.data(), directions.data(),
        static_cast<int64_t>(directions.shape(0)), entered.data());
}

void sweep(const In& reference, const In& mask, const In& base, const In& ratios,
           const std::vector<SourceTuple>& sources, int kept, int radius, Out cost) {
  expect(reference.ndim() == 2, "a reference");
  const size_t height = reference.shape(0), width = reference.shape(1), pixels = height * width;
  expect(height > 1 && width > 1 && mask.size() == pixels && base.size() == pixels, "mask or base");
  expect(cost.size() == pixels * ratios.size(), "costs");
  expect(!sources.empty() && kept >= 1 && kept <= static_cast<int>(sources.size()) && radius >= 0, "sources");
  std::vector<SweepSource> packed;
  for (const auto& [grey, valid, matrix, offset] : sources) {
    expect(grey.size() == pixels && valid.size() == pixels && matrix.size() == 9 && offset.size() == 3, "a source");
    SweepSource source{grey.data(), valid.data(), {}, {}};
    std::copy_n(matrix.data(), 9, source.from_pixel);
    std::copy_n(offset.data(), 3, source.offset);
    packed.push_back(source);
  }
  const SweepImages images{static_cast<int>(height), static_cast<int>(width), static_cast<int>(ratios.size()),
                           static_cast<int>(packed.size()), kept, radius, reference.data(), mask.data(),
                           base.data(), ratios.data(), packed.data(), cost.data()};
  nb::gil_scoped_release release_gil;
  StereoMemory& memory = *stereo_memory;
  const std::lock_guard<std::mutex> lock(memory.mutex);
  active()->sweep(&images, memory.scratch);
}

void semi_global(const In& cost, const In& grey, float small_step, float jump, float edge, Out position, Out lowest,
                 Out margin) {
  expect(cost.ndim() == 3 && cost.shape(0) >= 3, "costs");
  const size_t pixels = cost.shape(1) * cost.shape(2);
  expect(grey.size() == pixels && position.size() == pixels && lowest.size() == pixels && margin.size() == pixels,
         "an image");
  const SemiGlobal job{static_cast<int>(cost.shape(1)), static_cast<int>(cost.shape(2)),
                       static_cast<int>(cost.shape(0)), cost.data(), grey.data(), small_step, jump, edge,
                       position.data(), lowest.data(), margin.data()};
  nb::gil_scoped_release release_gil;
  StereoMemory& memory = *stereo_memory;
  const std::lock_guard<std::mutex> lock(memory.mutex);
  active()->semi_global(&job, &memory.volume, memory.scratch);
}

// Values, gradients, first and second moments, learning rate or one per column
using AdamTuple = std::tuple<nb::object, In, nb::object, nb::object, std::variant<float, std::vector<float>>>;

// An array that is changed in place. An argument of type `Out` would be converted where it does not fit, and the
// copy changed instead.
Out in_place(const nb::object& array, const char* what) {
  Out found;
  if (!nb::try_cast<Out>(array, found, false)) {
    throw std::invalid_argument(std::string(what) + " must be float32, contiguous and writable");
  }
  return found;
}

void adam(const std::vector<AdamTuple>& parameters, const Counts& steps, const In& bias1, const In& bias2,
          std::optional<Flags> visible, double beta1, double beta2, float eps) {
  const size_t rows = steps.shape(0);
  std::vector<AdamArray> arrays;
  std::vector<std::vector<float>> column_rates;
  column_rates.reserve(parameters.size());
  for (const auto& [values_given, gradients, first_given, second_given, rate] : parameters) {
    const Out values = in_place(values_given, "values"), first = in_place(first_given, "first moments"),
              second = in_place(second_given, "second moments");
    const size_t size = values.size();
    expect(rows > 0 && size % rows == 0, "values");
    expect(gradients.size() == size && first.size() == size && second.size() == size, "gradients or moments");
    const size_t columns = size / rows;
    AdamArray array{values.data(), gradients.data(),             first.data(),
                    second.data(), static_cast<int64_t>(columns), 0.f,          nullptr};
    if (const float* one = std::get_if<float>(&rate)) {
      array.rate = *one;
    } else {
      std::vector<float> rates = std::get<1>(rate);
      expect(rates.size() == columns && columns > 0, "learning rates");
      // The kernel loads sixteen from any column on.
      for (size_t k = 0; k < 15; ++k) rates.push_back(rates[k]);
      column_rates.push_back(std::move(rates));
      array.rates = column_rates.back().data();
    }
    arrays.push_back(array);
  }
  expect(bias1.size() == bias2.size(), "bias corrections");
  expect(!visible || visible->shape(0) == rows, "visible");
  int32_t least = 0, most = 0;
  for (size_t i = 0; i < rows; ++i) {
    least = std::min(least, steps.data()[i]);
    most = std::max(most, steps.data()[i]);
  }
  expect(least >= 0 && static_cast<size_t>(most) < bias1.size(), "steps");
  const AdamStep step{arrays.data(), static_cast<int>(arrays.size()), static_cast<int64_t>(rows),
                      steps.data(), bias1.data(), bias2.data(), data_or_null(visible), eps,
                      static_cast<float>(beta1), static_cast<float>(beta2),
                      static_cast<float>(1 - beta1), static_cast<float>(1 - beta2)};
  nb::gil_scoped_release release_gil;
  active()->adam(&step);
}

int64_t first_nonfinite(const In& values) {
  nb::gil_scoped_release release_gil;
  return active()->first_nonfinite(values.data(), static_cast<int64_t>(values.size()));
}

}  // namespace

NB_MODULE(_native, m) {
  pthread_atfork(nullptr, nullptr, renew_stereo_memory);
  // Frames may well be alive, in graphs nobody walked back, when the interpreter ends.
  nb::set_leak_warnings(false);
  m.doc() = "Compiled kernels of extrags.raster; use them through extrags.raster.";
  nb::class_<GaussianArrays>(m, "Gaussians", "A scene's Gaussians; `sh` or `colors`, not both.")
      .def("__init__",
           [](GaussianArrays* self, const In& means, const In& quats, const In& scales, const In& opacities,
              const std::optional<In>& sh, const std::optional<In>& colors) {
             new (self) GaussianArrays{means, quats, scales, opacities, sh, colors};
             self->check();
           },
           nb::kw_only(), nb::arg("means").noconvert(), nb::arg("quats").noconvert(),
           nb::arg("scales").noconvert(), nb::arg("opacities").noconvert(),
           nb::arg("sh").none().noconvert() = nb::none(), nb::arg("colors").none().noconvert() = nb::none());
  nb::class_<CameraSettings>(m, "Camera", "A camera, the light it carries and what it sees behind all.")
      .def(nb::init<const In&, const In&, int, int, float, const std::optional<In>&, const std::optional<In>&,
                    const std::optional<In>&>(),
           nb::kw_only(), nb::arg("viewmat"), nb::arg("K"), nb::arg("width"), nb::arg("height"),
           nb::arg("near"), nb::arg("background").none() = nb::none(), nb::arg("light").none() = nb::none(),
           nb::arg("lens").none() = nb::none());
  nb::class_<ImageArrays>(m, "Images", "What a forward pass fills.")
      .def(nb::init<Out, Out, Out, Out, Out, std::optional<Out>, std::optional<Out>, std::optional<Out>,
                    std::optional<In>>(),
           nb::kw_only(), nb::arg("rgb").noconvert(), nb::arg("alpha").noconvert(),
           nb::arg("depth").noconvert(), nb::arg("means2d").noconvert(), nb::arg("radius").noconvert(),
           nb::arg("median_depth").none().noconvert() = nb::none(),
           nb::arg("visibility_max").none().noconvert() = nb::none(),
           nb::arg("visibility_sum").none().noconvert() = nb::none(),
           nb::arg("visibility_mask").none().noconvert() = nb::none());
  nb::class_<ImageGradientArrays>(m, "ImageGradients",
                                  "Of the loss; that of the depth needs the forward's depth image too.")
      .def(nb::init<std::optional<In>, std::optional<In>, std::optional<In>, std::optional<In>>(),
           nb::kw_only(), nb::arg("rgb").none() = nb::none(), nb::arg("alpha").none() = nb::none(),
           nb::arg("depth").none() = nb::none(), nb::arg("depth_image").none() = nb::none());
  nb::class_<GaussianGradientArrays>(m, "GaussianGradients", "What a backward pass fills; None is left out.")
      .def(nb::init<std::optional<Out>, std::optional<Out>, std::optional<Out>, std::optional<Out>,
                    std::optional<Out>, std::optional<Out>, std::optional<Out>, std::optional<Out>>(),
           nb::kw_only(), nb::arg("means").none().noconvert() = nb::none(),
           nb::arg("quats").none().noconvert() = nb::none(), nb::arg("scales").none().noconvert() = nb::none(),
           nb::arg("opacities").none().noconvert() = nb::none(),
           nb::arg("sh").none().noconvert() = nb::none(), nb::arg("colors").none().noconvert() = nb::none(),
           nb::arg("means2d").none().noconvert() = nb::none(),
           nb::arg("absolute2d").none().noconvert() = nb::none());
  nb::class_<CameraGradientArrays>(m, "CameraGradients", "What a backward pass fills; None is left out.")
      .def(nb::init<std::optional<Out>, std::optional<Out>>(), nb::kw_only(),
           nb::arg("viewmat").none().noconvert() = nb::none(),
           nb::arg("light").none().noconvert() = nb::none());
  nb::class_<Frame>(m, "Frame", "What the forward pass of one camera leaves for the backward pass.")
      .def("backward", &frame_backward, nb::arg("gaussians"), nb::arg("images"), nb::arg("gradients"),
           nb::arg("camera"), nb::kw_only(), nb::arg("add") = false,
           "Fill the gradients, or add to those of the Gaussians' own arrays.")
      .def("entries", &frame_entries,
           "How many (Gaussian, 4 x 4 pixel block) entries some pixel composited or ended at.")
      .def("seconds", &frame_seconds,
           "Of the projection, the tiles, the tiles backward and the projection backward.")
      .def("query", &frame_query, nb::arg("points"), nb::arg("transmittance").noconvert());
  m.def("render", &render, nb::arg("gaussians"), nb::arg("camera"), nb::arg("images"), nb::kw_only(),
        nb::arg("degree"), nb::arg("check") = false,
        "Render one camera; `degree` is that of the harmonics used. With `check`, None where an array of the "
        "Gaussians holds a NaN or an infinity.");
  m.def("l1_ssim", &l1_ssim, nb::arg("image"), nb::arg("target"), nb::arg("mask").none(),
        nb::arg("gradient").noconvert(), nb::arg("dssim_weight"), nb::arg("scale"),
        nb::arg("ssim_mask").none() = nb::none());
  m.def("inverse_depth", &inverse_depth, nb::arg("depth"), nb::arg("alpha"), nb::arg("target"),
        nb::arg("gradient").noconvert(), nb::arg("scale"), nb::arg("weight"),
        nb::arg("confidence").none() = nb::none());
  m.def("march", &march_rays, nb::arg("reach").noconvert(), nb::arg("start").noconvert(),
        nb::arg("directions").noconvert(), nb::arg("entered").noconvert(),
        "Flat index of the first voxel without reach on each ray, -1 where a ray leaves the grid.");
  m.def("sweep", &sweep, nb::arg("reference"), nb::arg("mask"), nb::arg("base"), nb::arg("ratios"),
        nb::arg("sources"), nb::arg("kept"), nb::arg("radius"), nb::arg("cost").noconvert());
  m.def("semi_global", &semi_global, nb::arg("cost"), nb::arg("grey"), nb::arg("small_step"), nb::arg("jump"),
        nb::arg("edge"), nb::arg("position").noconvert(), nb::arg("lowest").noconvert(),
        nb::arg("margin").noconvert());
  m.def("adam", &adam, nb::arg("parameters"), nb::arg("steps").noconvert(), nb::arg("bias1"),
        nb::arg("bias2"), nb::arg("visible").none().noconvert(), nb::arg("beta1"), nb::arg("beta2"),
        nb::arg("eps"));
  m.def("first_nonfinite", &first_nonfinite, nb::arg("values"));
  m.def("fma_chain", [](int64_t rounds) { return active()->fma_chain(rounds); }, nb::arg("rounds"));
  m.def("isa", [] { return std::string(active()->name); });
  m.def("set_isa", [](const std::string& name) { active() = find_table(name); }, nb::arg("name"));
  m.def("usable_isas", [] {
    std::vector<std::string> names;
    for (const KernelTable* table : usable_tables()) names.emplace_back(table->name);
    return names;
  });
  m.def("set_num_threads", &set_num_threads, nb::arg("count"));
  m.def("num_threads", &num_threads);
}
