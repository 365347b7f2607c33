// The data the kernels work on and the table of functions each instruction set provides.
#pragma once

#include <cstddef>
#include <cstdint>

#include "runtime.h"

namespace extrags {

// Conventions shared with gsplat and with the torch reference (rendering.py).
constexpr float kDilation = 0.3f;
constexpr float kAlphaMax = 0.999f;
constexpr float kAlphaMin = 1.f / 255.f;
constexpr float kTransmittanceMin = 1e-4f;
constexpr float kFieldOfViewMargin = 0.3f;
constexpr float kAlphaEps = 1e-10f;
// Larger projected covariances (px^2) are culled: beyond it float32 products overflow.
constexpr float kCovarianceMax = 1e12f;

// A tile is 8 x 8 blocks of 4 x 4 pixels: small enough for its Gaussians and their gradients to stay in the
// first caches, large enough that few Gaussians touch several.
constexpr int kTileBlocks = 8, kTilePx = 4 * kTileBlocks;

// A radial lens, as `RadialLens.packed` of radial_lens.py gives it.
constexpr int kSeriesTerms = 14;
constexpr float kSeriesSquare = 0.18f;  // up to this squared tangent the series holds
struct RadialLens {
  float coefficients[4];      // k1 to k4 of r(angle)
  float series[kSeriesTerms];  // of r / tan(angle) by the squared tangent
  float linear_from;           // angle from which r grows linearly
  float culled_from;           // squared tangent of the angle beyond which Gaussians are culled
};
static_assert(sizeof(RadialLens) == 80, "the caller hands over twenty floats");

struct Camera {
  float rotation[9];  // camera from world, row-major
  float translation[3];
  float fx, fy, cx, cy;
  bool bent;  // by the lens; else a pinhole
  RadialLens lens;
};

// The light that rides on the camera; see light.py.
struct CameraLight {
  float exposure[3];
  float softening, exponent, spread, cosine;
  float offset[3];
  float shoulder;
  float specular, roughness;
  float glare[3];
  float reference_distance;  // a gauge, not learned
};
constexpr int kLightLearned = 16, kLightRow = kLightLearned + 1;
static_assert(sizeof(CameraLight) == sizeof(float) * kLightRow, "the caller hands over a row of floats");
constexpr int kPartials = 32;  // floats per chunk of Gaussians: 15 of the pose, those of the light from 16 on
static_assert(16 + kLightLearned <= kPartials);

// Arrays of the caller, row-major and contiguous.
struct Scene {
  int n;
  const float* means;      // [n, 3]
  const float* quats;      // [n, 4]
  const float* scales;     // [n, 3], linear
  const float* opacities;  // [n], in (0, 1)
  const float* sh;         // [n, coefficients, 3], or null when colors is given
  int coefficients;
  int degree;
  const float* colors;  // [n, 3]
};

// A Gaussian as one camera sees it, one cache line. The exponent of its alpha at a pixel is, in powers of
// two, log2_opacity + xx dx^2 + xy dx dy + yy dy^2 with (dx, dy) = mean - pixel.
struct alignas(64) Record {
  float x, y;
  float xx, xy, yy;
  float log2_opacity;
  float color[3];
  float depth;
  // The ellipse where alpha falls to 1/255: at height dy above the mean it spans
  // slope dy +- sqrt(shape (half_height^2 - dy^2)); its rightmost point is at dy = right_dy.
  float half_height, slope, shape, right_dy;
  // Pairs of a Gaussian and a tile are numbered by Gaussian, then by row and column of the tile: that of tile
  // (x, y) is the chunk's first + pair + y tiles_across + x. In a tile's own copy `pair` is the number itself.
  uint32_t pair, tiles_across;
};
static_assert(sizeof(Record) == 64, "one cache line per Gaussian");

// Tiles (inclusive) a Gaussian touches; x1 < x0 when it is culled.
struct TileRect {
  uint16_t x0, y0, x1, y1;
};

struct DepthKey {
  uint32_t depth_bits;
  int32_t id;
};

// All that one camera's forward pass leaves for its backward pass, and working memory.
struct View {
  int width, height;
  int tiles_x, tiles_y;
  int n, chunk, chunks;  // Gaussians are handled in chunks of a fixed size
  float near;
  float background[3];
  Camera camera;
  bool lit;
  CameraLight light;

  Buffer records;      // Record [n]
  Buffer rects;        // TileRect [n]
  Buffer depths;       // uint32 [n]: bits of the depth of a record
  Buffer pair_starts;  // uint32 [n + 1]: where the (Gaussian, tile) pairs of a Gaussian start
  Buffer counts;       // uint32 [chunks, tiles]
  Buffer chunk_pairs;  // uint32 [chunks + 1]: where the pairs of a chunk start
  Buffer tile_starts;  // uint32 [tiles + 1]: where the pairs of a tile start
  Buffer keys;         // DepthKey [pairs], per tile
  Buffer locals;       // Record [pairs], per tile, nearest first
  Buffer block_starts;  // uint32 [tiles, blocks + 1]: where a block's entries start in its tile
  Buffer block_kept;    // uint32 [tiles, blocks]: entries that some pixel composited or ended at
  Buffer finals;        // float [tiles, blocks, 16]: final transmittance
  Buffer lasts;         // float [tiles, blocks, 16]: how many kept entries a pixel went through
  Buffer tile_entries;  // Buffer [tiles]: indices into the tile's locals, per block, and `entry_hits`
  int tile_entries_count;
  Buffer pair_rows;  // float [pairs, 16], per Gaussian: gradients, or visibility
  Buffer partials;   // float [chunks, kPartials]: gradients of camera and light
  Buffer query;      // working memory of transmittance queries
  Buffer scratch[kMaxThreads];
  bool check;   // whether the projection looks for NaN and infinities
  bool finite;  // it found none
  double seconds[4];  // projection, tiles, tiles backward, projection backward of the last calls
};

struct Images {
  float* rgb;           // [h, w, 3]
  float* alpha;         // [h, w]
  float* depth;         // [h, w]
  float* median_depth;  // [h, w] or null
  float* means2d;       // [n, 2]
  float* radius;        // [n]
  float* visibility_max;  // [n] or null
  float* visibility_sum;  // [n] or null
  const float* visibility_mask;  // [h, w] of 0 and 1, or null: the pixels that count for visibility
};

struct ImageGradients {
  const float* rgb;    // [h, w, 3] or null
  const float* alpha;  // [h, w] or null
  const float* depth;  // [h, w] or null
  const float* depth_image;  // the forward's depth, needed with `depth`
};

// Gradients are written, or added to when `add` is set. Any may be null.
struct SceneGradients {
  bool add;
  float* means;
  float* quats;
  float* scales;
  float* opacities;
  float* sh;
  float* colors;      // written
  float* viewmat;     // [4, 4], written
  float* light;       // [kLightRow], written
  float* means2d;     // [n, 2], written
  float* absolute2d;  // [n, 2], written
};

struct AdamArray {
  float* values;  // [rows, columns], like the next three
  const float* gradients;
  float* first;
  float* second;
  int64_t columns;
  float rate;
  const float* rates;  // of each column, and 15 more that begin anew; or null: `rate` for all
};

struct AdamStep {
  const AdamArray* arrays;
  int count;
  int64_t rows;
  const int32_t* steps;    // [rows], counted up already
  const float* bias1;      // 1 / (1 - beta1^t), by t
  const float* bias2;      // 1 / sqrt(1 - beta2^t), by t
  const uint8_t* visible;  // [rows] or null
  float eps;
  float beta1, beta2, rest1, rest2;  // rest = 1 - beta, rounded once
};

struct LossImages {
  int height, width;
  const float* image;      // [h, w, 3]
  const float* target;     // [h, w, 3]
  const float* mask;       // [h, w] or null: weights of both terms, or of L1 alone
  const float* ssim_mask;  // [h, w] or null: weights of SSIM where they are others
  float* gradient;         // [h, w, 3]: of the sum
  float dssim_weight;
  double scale;  // of both weighted sums
};

struct DepthImages {
  int64_t pixels;
  const float* depth;   // rendered
  const float* alpha;   // rendered
  const float* target;  // 0 where there is none
  const float* confidence;  // in [0, 1], or null: one everywhere
  float* gradient;      // of weight times the mean
  float scale, weight;
};

// A source frame of a sweep: homogeneous pixel = (from_pixel * reference pixel) * depth + offset.
struct SweepSource {
  const float* grey;  // [h, w]
  const float* mask;  // [h, w]: one where it counts
  float from_pixel[9];
  float offset[3];
};

struct SweepImages {
  int height, width, steps, n_sources, kept, radius;
  const float* reference;  // [h, w]: brightness less its local mean, zero outside the mask
  const float* mask;       // [h, w]
  const float* base;       // [h, w]: depth
  const float* ratios;     // [steps]: of hypothesis and base
  const SweepSource* sources;
  float* cost;  // [steps, h, w]
};

struct SemiGlobal {
  int height, width, steps;
  const float* cost;  // [steps, h, w]
  const float* grey;  // [h, w]
  float small_step, jump, edge;
  float* position;  // [h, w], as the next two
  float* lowest;
  float* margin;
};

struct KernelTable {
  const char* name;
  void (*forward)(View*, const Scene*, const Images*);
  void (*backward)(View*, const Scene*, const ImageGradients*, const SceneGradients*);
  void (*query)(View*, const float* points, int64_t count, float* transmittance);
  double (*loss)(const LossImages*, Buffer* working);
  double (*inverse_depth)(const DepthImages*, Buffer* working, int64_t* compared);
  void (*adam)(const AdamStep*);
  void (*sweep)(const SweepImages*, Buffer* scratch);
  void (*semi_global)(const SemiGlobal*, Buffer* volume, Buffer* scratch);
  int64_t (*first_nonfinite)(const float* values, int64_t count);
  double (*fma_chain)(int64_t rounds);
};

// One per instruction set; see kernels.inl.
#if defined(__x86_64__)
namespace avx512 {
extern const KernelTable table;
}
namespace avx2 {
extern const KernelTable table;
}
#endif
namespace portable {
extern const KernelTable table;
}

}  // namespace extrags
