// Checks and order of observations; twin of v2hdm.adjust.kernels.layout.
#pragma once

#include "adjust.h"

namespace v2hdm::adjust {

// layout.Seen, of so many observations.
struct Columns {
    const Index *camera, *frame, *corner;
    const double *pinhole_px, *covariance_px, *intrinsic;
    Index count;
};

// Index of the first unsound observation, or -1; counts the observations of each corner and camera.
struct Tally {
    Index *by_corner, *by_camera;
    Index corners, cameras;
};
Index first_unsound(
    const Columns& columns, Index frames, double symmetric_to, double max_slope, const Tally& tally);

// Observations in order, (K,), (2, K) and (3, K); layout.lay_out.
struct Ordered {
    int32_t *corner, *pair;
    double *measured, *root;
};
Index lay_out(const Columns& columns, const Index* rank, Index frames, const Index* order, const Ordered& out);

}  // namespace v2hdm::adjust
