// The kernels for one instruction set. The including file sets EXTRAGS_ISA (the name of the namespace) and
// EXTRAGS_ISA_NAME and is compiled with that set's flags. Nothing here may use standard containers or other
// inline code from outside: see runtime.h.

#include <cstdint>
#include <cstring>

#if defined(__x86_64__)
#include <immintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

#include "kernels.h"

#if defined(__FAST_MATH__)
#error "the kernels rely on IEEE arithmetic: do not compile them with -ffast-math"
#endif

namespace extrags {
namespace EXTRAGS_ISA {

#include "simd.h"

#include "project.inl"
#include "project_backward.inl"

#include "composite.inl"
#include "query.inl"

#include "adam.inl"
#include "loss.inl"
#include "inverse_depth.inl"
#include "sweep.inl"

struct ViewContext {
  View* view;
  const Scene* scene;
  const Images* images;
  const ImageGradients* image_gradients;
  const SceneGradients* scene_gradients;
};

// Whether all values are finite: x - x is zero for finite x, else NaN, and a NaN stays in the sum.
static bool all_finite(const float* values, int64_t count) {
  Vec total[4] = {Vec(0.f), Vec(0.f), Vec(0.f), Vec(0.f)};
  int64_t i = 0;
  for (; i + 64 <= count; i += 64) {
    for (int k = 0; k < 4; ++k) {
      const Vec x = load(values + i + 16 * k);
      total[k] = total[k] + (x - x);
    }
  }
  float poison = sum((total[0] + total[1]) + (total[2] + total[3]));
  for (; i < count; ++i) poison += values[i] - values[i];
  return poison == 0.f;
}

// A chunk's parameters, just before they are projected: they are read from memory once.
static bool chunk_finite(const Scene& scene, int64_t begin, int64_t end) {
  const int64_t count = end - begin, of_sh = 3 * static_cast<int64_t>(scene.coefficients);
  return all_finite(scene.means + 3 * begin, 3 * count) && all_finite(scene.quats + 4 * begin, 4 * count) &&
         all_finite(scene.scales + 3 * begin, 3 * count) && all_finite(scene.opacities + begin, count) &&
         (scene.colors == nullptr || all_finite(scene.colors + 3 * begin, 3 * count)) &&
         (scene.sh == nullptr || all_finite(scene.sh + of_sh * begin, of_sh * count));
}

template <bool kLens>
static void project_task(void* data, int chunk, int) {
  const ViewContext& c = *static_cast<ViewContext*>(data);
  const int begin = chunk * c.view->chunk, rest = c.scene->n - begin;
  if (c.view->check && !chunk_finite(*c.scene, begin, begin + (rest < c.view->chunk ? rest : c.view->chunk))) {
    __atomic_store_n(&c.view->finite, false, __ATOMIC_RELAXED);
    return;
  }
  if (c.scene->colors != nullptr) return project_chunk<0, true, kLens>(c.view, c.scene, c.images, chunk);
  switch (c.scene->degree) {
    case 0: return project_chunk<0, false, kLens>(c.view, c.scene, c.images, chunk);
    case 1: return project_chunk<1, false, kLens>(c.view, c.scene, c.images, chunk);
    case 2: return project_chunk<2, false, kLens>(c.view, c.scene, c.images, chunk);
    default: return project_chunk<3, false, kLens>(c.view, c.scene, c.images, chunk);
  }
}

// Lists the pairs of one chunk: per tile its Gaussians, per Gaussian where its pairs start. Records are not
// touched: at a cache line each they would be most of what is read.
static void list_task(void* data, int chunk, int) {
  View* view = static_cast<ViewContext*>(data)->view;
  const int tiles = view->tiles_x * view->tiles_y;
  uint32_t* ends = static_cast<uint32_t*>(view->counts.data) + static_cast<size_t>(chunk) * tiles;
  const uint32_t first_pair = static_cast<uint32_t*>(view->chunk_pairs.data)[chunk];
  uint32_t* starts = static_cast<uint32_t*>(view->pair_starts.data);
  const TileRect* rects = static_cast<const TileRect*>(view->rects.data);
  const uint32_t* depths = static_cast<const uint32_t*>(view->depths.data);
  DepthKey* keys = static_cast<DepthKey*>(view->keys.data);
  const int begin = chunk * view->chunk;
  const int end = begin + view->chunk < view->n ? begin + view->chunk : view->n;
  for (int id = begin; id < end; ++id) {
    starts[id] += first_pair;
    const TileRect rect = rects[id];
    if (rect.x1 < rect.x0) continue;
    const DepthKey key{depths[id], id};
    for (int ty = rect.y0; ty <= rect.y1; ++ty) {
      for (int tx = rect.x0; tx <= rect.x1; ++tx) keys[ends[ty * view->tiles_x + tx]++] = key;
    }
  }
}

static void tile_task(void* data, int tile, int slot) {
  const ViewContext& c = *static_cast<ViewContext*>(data);
  forward_tile(c.view, c.images, tile, slot);
}

static void tile_backward_task(void* data, int tile, int slot) {
  const ViewContext& c = *static_cast<ViewContext*>(data);
  backward_tile(c.view, c.image_gradients, c.scene_gradients->absolute2d != nullptr, tile, slot);
}

template <int kDegree, bool kColors, bool kLens>
static void project_backward(const ViewContext& c, int chunk) {
  // With a lens the gradient of the pose is always carried along: fewer instances to compile.
  if (kLens || c.scene_gradients->viewmat != nullptr) {
    project_chunk_backward<kDegree, kColors, true, kLens>(c.view, c.scene, c.scene_gradients, chunk);
  } else {
    project_chunk_backward<kDegree, kColors, kLens, kLens>(c.view, c.scene, c.scene_gradients, chunk);
  }
}

template <bool kLens>
static void project_backward_task(void* data, int chunk, int) {
  const ViewContext& c = *static_cast<ViewContext*>(data);
  if (c.scene->colors != nullptr) return project_backward<0, true, kLens>(c, chunk);
  switch (c.scene->degree) {
    case 0: return project_backward<0, false, kLens>(c, chunk);
    case 1: return project_backward<1, false, kLens>(c, chunk);
    case 2: return project_backward<2, false, kLens>(c, chunk);
    default: return project_backward<3, false, kLens>(c, chunk);
  }
}

static void visibility_task(void* data, int chunk, int) {
  const ViewContext& c = *static_cast<ViewContext*>(data);
  const View* view = c.view;
  const uint32_t* starts = static_cast<const uint32_t*>(view->pair_starts.data);
  const float* rows = static_cast<const float*>(view->pair_rows.data);
  const int begin = chunk * view->chunk;
  const int end = begin + view->chunk < view->n ? begin + view->chunk : view->n;
  for (int id = begin; id < end; ++id) {
    float best = 0, total = 0;
    for (uint32_t pair = starts[id]; pair < starts[id + 1]; ++pair) {
      best = rows[2 * static_cast<size_t>(pair)] > best ? rows[2 * static_cast<size_t>(pair)] : best;
      total += rows[2 * static_cast<size_t>(pair) + 1];
    }
    c.images->visibility_max[id] = best;
    c.images->visibility_sum[id] = total;
  }
}

// Sizes that depend on the image and on the number of Gaussians only, never on the number of threads.
static void lay_out(View* view, int n) {
  view->n = n;
  view->tiles_x = (view->width + kTilePx - 1) / kTilePx;
  view->tiles_y = (view->height + kTilePx - 1) / kTilePx;
  const size_t tiles = static_cast<size_t>(view->tiles_x) * view->tiles_y;
  view->chunk = 512;
  do {
    view->chunks = (n + view->chunk - 1) / view->chunk;
    if (view->chunks * tiles <= (1u << 20) || view->chunks <= 16) break;
    view->chunk *= 2;
  } while (true);
  const size_t count = static_cast<size_t>(n), blocks = kBlocks;
  reserve(&view->records, sizeof(Record) * (count + 1));
  reserve(&view->rects, sizeof(TileRect) * (count + 1));
  reserve(&view->depths, sizeof(uint32_t) * (count + 1));
  reserve(&view->pair_starts, sizeof(uint32_t) * (count + 1));
  reserve(&view->counts, sizeof(uint32_t) * (view->chunks * tiles + 1));
  reserve(&view->chunk_pairs, sizeof(uint32_t) * (view->chunks + 1));
  reserve(&view->tile_starts, sizeof(uint32_t) * (tiles + 1));
  reserve(&view->block_starts, sizeof(uint32_t) * tiles * (blocks + 1));
  reserve(&view->block_kept, sizeof(uint32_t) * tiles * blocks);
  reserve(&view->finals, sizeof(float) * tiles * blocks * 16);
  if (view->tile_entries_count < static_cast<int>(tiles)) {
    Buffer fresh{nullptr, 0};
    reserve(&fresh, sizeof(Buffer) * tiles);
    memset(fresh.data, 0, sizeof(Buffer) * tiles);
    if (view->tile_entries_count > 0) {
      memcpy(fresh.data, view->tile_entries.data, sizeof(Buffer) * view->tile_entries_count);
    }
    release(&view->tile_entries);
    view->tile_entries = fresh;
    view->tile_entries_count = static_cast<int>(tiles);
  }
}

static void forward(View* view, const Scene* scene, const Images* images) {
  const double started = monotonic_seconds();
  lay_out(view, scene->n);
  ViewContext c{view, scene, images, nullptr, nullptr};
  view->finite = true;
  parallel_for(view->chunks, view->camera.bent ? project_task<true> : project_task<false>, &c);
  if (!view->finite) return;

  // Where each tile's pairs start, and in it those of each chunk
  const size_t tiles = static_cast<size_t>(view->tiles_x) * view->tiles_y;
  uint32_t* counts = static_cast<uint32_t*>(view->counts.data);
  uint32_t* starts = static_cast<uint32_t*>(view->tile_starts.data);
  memset(starts, 0, sizeof(uint32_t) * (tiles + 1));
  for (int chunk = 0; chunk < view->chunks; ++chunk) {
    for (size_t tile = 0; tile < tiles; ++tile) starts[tile + 1] += counts[chunk * tiles + tile];
  }
  // The projection's own numbers of pairs wrap where there are too many; they are not used then.
  uint64_t listed_pairs = 0;
  for (size_t tile = 0; tile < tiles; ++tile) {
    listed_pairs += starts[tile + 1];
    starts[tile + 1] = static_cast<uint32_t>(listed_pairs);
  }
  check_countable(listed_pairs, "a Gaussian and a tile");
  // A running sum down the chunks, row by row: a column at a time would miss the caches at every step.
  reserve(&view->scratch[0], sizeof(uint32_t) * tiles);
  uint32_t* next = static_cast<uint32_t*>(view->scratch[0].data);
  memcpy(next, starts, sizeof(uint32_t) * tiles);
  for (int chunk = 0; chunk < view->chunks; ++chunk) {
    uint32_t* row = counts + chunk * tiles;
    for (size_t tile = 0; tile < tiles; ++tile) {
      const uint32_t count = row[tile];
      row[tile] = next[tile];
      next[tile] += count;
    }
  }
  uint32_t* chunk_pairs = static_cast<uint32_t*>(view->chunk_pairs.data);
  uint32_t pairs = 0;
  for (int chunk = 0; chunk < view->chunks; ++chunk) {
    const uint32_t count = chunk_pairs[chunk];
    chunk_pairs[chunk] = pairs;
    pairs += count;
  }
  static_cast<uint32_t*>(view->pair_starts.data)[scene->n] = pairs;
  reserve(&view->keys, sizeof(DepthKey) * (static_cast<size_t>(pairs) + 1));
  reserve(&view->locals, sizeof(Record) * (static_cast<size_t>(pairs) + 1));
  parallel_for(view->chunks, list_task, &c);
  const double listed = monotonic_seconds();

  if (images->visibility_max != nullptr) {
    reserve(&view->pair_rows, sizeof(float) * 2 * (static_cast<size_t>(pairs) + 1));
  }
  parallel_for(static_cast<int>(tiles), tile_task, &c);
  if (images->visibility_max != nullptr) parallel_for(view->chunks, visibility_task, &c);
  view->seconds[0] = listed - started;
  view->seconds[1] = monotonic_seconds() - listed;
}

// As `finite` of project.inl, for one number
static float finite_float(double value) { return value > -3e38 && value < 3e38 ? static_cast<float>(value) : 0.f; }

static void backward(View* view, const Scene* scene, const ImageGradients* in, const SceneGradients* out) {
  const double started = monotonic_seconds();
  const uint32_t pairs = static_cast<const uint32_t*>(view->pair_starts.data)[scene->n];
  reserve(&view->pair_rows, sizeof(float) * 16 * (static_cast<size_t>(pairs) + 1));
  ViewContext c{view, scene, nullptr, in, out};
  parallel_for(view->tiles_x * view->tiles_y, tile_backward_task, &c);
  const double carried = monotonic_seconds();
  reserve(&view->partials, sizeof(float) * kPartials * (view->chunks + 1));
  parallel_for(view->chunks, view->camera.bent ? project_backward_task<true> : project_backward_task<false>, &c);
  view->seconds[2] = carried - started;
  view->seconds[3] = monotonic_seconds() - carried;
  const float* partials = static_cast<const float*>(view->partials.data);
  if (out->light != nullptr) {
    double light[kLightLearned] = {};
    for (int chunk = 0; chunk < view->chunks; ++chunk) {
      for (int k = 0; k < kLightLearned; ++k) light[k] += static_cast<double>(partials[kPartials * chunk + 16 + k]);
    }
    for (int k = 0; k < kLightLearned; ++k) out->light[k] = finite_float(light[k]);
    out->light[kLightLearned] = 0;
  }
  if (out->viewmat == nullptr) return;
  double pose[15] = {};
  for (int chunk = 0; chunk < view->chunks; ++chunk) {
    for (int k = 0; k < 15; ++k) pose[k] += static_cast<double>(partials[kPartials * chunk + k]);
  }
  const float *r = view->camera.rotation, *t = view->camera.translation;
  memset(out->viewmat, 0, sizeof(float) * 16);
  for (int i = 0; i < 3; ++i) {
    double v_translation = pose[9 + i];
    for (int j = 0; j < 3; ++j) {
      // The offset from the camera is mean + rotation^T translation.
      out->viewmat[4 * i + j] = finite_float(pose[3 * i + j] + static_cast<double>(t[i]) * pose[12 + j]);
      v_translation += static_cast<double>(r[3 * i + j]) * pose[12 + j];
    }
    out->viewmat[4 * i + 3] = finite_float(v_translation);
  }
}

constexpr int64_t kFiniteValues = 1 << 18;  // a task, at least
constexpr int kFiniteTasks = 256;           // at most

struct FiniteContext {
  const float* values;
  int64_t count, per_task;
  bool finite[kFiniteTasks];
};

static void finite_task(void* data, int task, int) {
  FiniteContext& c = *static_cast<FiniteContext*>(data);
  const int64_t begin = task * c.per_task, rest = c.count - begin;
  c.finite[task] = all_finite(c.values + begin, rest < c.per_task ? rest : c.per_task);
}

static int64_t first_nonfinite(const float* values, int64_t count) {
  FiniteContext c;
  c.values = values;
  c.count = count;
  c.per_task = kFiniteValues;
  while (c.per_task * kFiniteTasks < count) c.per_task *= 2;
  const int tasks = static_cast<int>((count + c.per_task - 1) / c.per_task);
  parallel_for(tasks, finite_task, &c);
  for (int task = 0; task < tasks; ++task) {
    if (c.finite[task]) continue;
    for (int64_t i = task * c.per_task; i < count; ++i) {
      if (!(values[i] - values[i] == 0.f)) return i;
    }
  }
  return -1;
}

// Sixteen independent chains of fused multiply-adds: the arithmetic peak.
static double fma_chain(int64_t rounds) {
  Vec chain[16];
  for (int i = 0; i < 16; ++i) chain[i] = Vec(1.f + static_cast<float>(i));
  const Vec factor(0.9999999f), term(1e-7f);
  for (int64_t k = 0; k < rounds; ++k) {
    for (int i = 0; i < 16; ++i) chain[i] = fma(chain[i], factor, term);
  }
  double total = 0;
  for (int i = 0; i < 16; ++i) total += static_cast<double>(sum(chain[i]));
  return total;
}

const KernelTable table = {EXTRAGS_ISA_NAME, forward, backward, query, loss, inverse_depth, adam,
                           sweep, semi_global, first_nonfinite, fma_chain};

}  // namespace EXTRAGS_ISA
}  // namespace extrags
