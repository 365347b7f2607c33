#pragma once

#include <cstdint>

namespace extrags {

// Follows rays from one point to the first voxel with a reach of zero; its flat index, or -1 for rays that
// leave the grid. `reach` is the distance of each voxel's centre to the nearest voxel that is not free, in
// voxels, [size, size, size]; start and unit directions are in voxel coordinates, voxel i covers [i, i + 1).
void march(const float* reach, int64_t size, const double* start, const double* directions, int64_t rays,
           int64_t* entered);

}  // namespace extrags
