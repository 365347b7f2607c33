// Rays through a voxel grid to the first voxel that is not free. Scalar and in doubles: rays diverge, and the
// voxels they end in must not depend on the instruction set.

#include "march.h"

#include <cmath>
#include <limits>

namespace extrags {

namespace {

// Half the diagonal of a voxel, rounded up: a point lies within this of its voxel's centre, in voxels.
constexpr double kHalfDiagonal = 0.87;
// Rays that leave a voxel go so far into the next one, in voxels.
constexpr double kBeyondFace = 1e-6;

}  // namespace

void march(const float* reach, int64_t size, const double* start, const double* directions, int64_t rays,
           int64_t* entered) {
  for (int64_t ray = 0; ray < rays; ++ray) {
    const double* step = directions + 3 * ray;
    double position[3] = {start[0], start[1], start[2]};
    entered[ray] = -1;
    for (;;) {
      int64_t voxel[3];
      bool inside = true;
      for (int axis = 0; axis < 3; ++axis) {
        const double corner = std::floor(position[axis]);
        // Written so that a NaN is outside.
        inside = inside && corner >= 0 && corner < static_cast<double>(size);
        voxel[axis] = inside ? static_cast<int64_t>(corner) : 0;
      }
      if (!inside) break;
      const int64_t at = (voxel[0] * size + voxel[1]) * size + voxel[2];
      const double free = reach[at];
      if (free == 0) {
        entered[ray] = at;
        break;
      }
      double leaving = std::numeric_limits<double>::infinity();
      for (int axis = 0; axis < 3; ++axis) {
        if (step[axis] == 0) continue;
        const double face = static_cast<double>(voxel[axis]) + (step[axis] > 0 ? 1 : 0);
        const double to_face = (face - position[axis]) / step[axis];
        if (to_face < leaving) leaving = to_face;
      }
      // The next voxel that is not free has its centre at `free`; both points lie off theirs.
      const double stride = free - 2 * kHalfDiagonal;
      const double advance = stride > leaving + kBeyondFace ? stride : leaving + kBeyondFace;
      if (!(advance < std::numeric_limits<double>::infinity())) break;
      for (int axis = 0; axis < 3; ++axis) position[axis] += advance * step[axis];
    }
  }
}

}  // namespace extrags
