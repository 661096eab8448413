// Checks and order of observations; twin of v2hdm.adjust.kernels.layout.
#pragma once

#include "adjust.h"

namespace v2hdm::adjust {

// Index of the first unsound observation, or -1; counts the observations of each corner and camera.
struct Tally {
    Index *by_corner, *by_camera;
    Index corners, cameras;
};
Index first_unsound(
    const Columns& columns, Index frames, double symmetric_to, double max_slope, const Tally& tally);

// Where observations end, sorted by the rank of their corner and by pair; ``corner_at`` counts those of corners.
struct Arranged {
    Index* corner_at;
    Index corners;
    int32_t *order, *corner, *pair;
};

// Position of a duplicate of the observation before, or -1.
Index arrange(const Columns& columns, const Index* rank, Index frames, const Arranged& out);

// Observations in an order: (2, K) where at depth 1, (3, K) root information. Returns how many are of lines.
Index lay_out(const Columns& columns, const Sorted& sorted, double line_excess, double* measured, double* root);

// solution.Verdict.
enum Verdict : int8_t { ACCEPTED, CONTRADICTS, UNCONFIRMED, BEHIND_CAMERA };

// Observations as a solve reports them, in the problem's order.
struct Reported {
    const Index* corner;
    const double* mahalanobis2;
    const bool* behind;
    Index count;
};

// Verdicts on them, and how many each corner has, and has accepted; those are zeros before.
struct Judged {
    int8_t* verdict;
    Index *sightings, *accepted;
    Index corners;
};

void classify(const Reported& reported, double gate, const Judged& out);

// Index of the first transform (4, 4) that is not rigid, or -1.
Index first_not_rigid(const double* transforms, Index count, double orthonormal_to);

// Pairs that chunks of observations touch, in turn, and the first of each chunk.
struct Touched {
    int32_t* pair;
    Index* at;
};

// Their number; ``chunk`` are the observations at which chunks begin, ``is_touched`` are zeros by pair.
Index find_touched(const int32_t* pair, const Index* chunk, Index chunks, uint8_t* is_touched, const Touched& out);

}  // namespace v2hdm::adjust
