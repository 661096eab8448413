// The adjustment's passes over observations; twin of v2hdm.adjust.kernels, which explains names and shapes.
#pragma once

#include <cstdint>

#if defined(__x86_64__) && defined(__GNUC__)
#define V2HDM_AVX2
#endif

namespace v2hdm::adjust {

using Index = int64_t;

// Constants of Python, by their names there.
constexpr double NEAR_M = 0.1;               // geometry.tensors
constexpr double WEIGHT_FLOOR = 1e-6;        // adjust.engine
constexpr double CORNER_FLOOR = 1e-10;       // adjust.reduced
constexpr double PIVOT_FLOOR = 1e-12;        // adjust.reduced
constexpr double MIN_DEPRESSION_SINE = 0.01; // adjust.model

enum Loss { NONE, HUBER, CAUCHY, GEMAN_MCCLURE };  // layout.LOSS_CODES

// layout.Layout.
struct Layout {
    Index observations, corners, units, chunks, moments, most_seen, most_joined;
    const int32_t* pair;
    const double *measured, *root;
    const Index *frame, *begin, *unit, *joint_at, *chunk;
    const int32_t* touched;
    const Index* touched_at;
    const double *control, *control_root;
    const Index *length_at, *length_first, *length_second;
    const double *length_m, *length_root;
    const bool* is_kept;
};

// layout.Base; ``has_rows`` is whether frames have no states.
struct Base {
    const double *table, *corners;
    Index pairs, corner_count, width;
    int code;
    double scale;
    double *lower, *joint, *rows;
    bool has_rows;
};

// layout.Scratch; a row of ``block`` and of ``rows`` has so many columns.
struct Scratch {
    int32_t* slot;
    double *coupling, *observed, *block, *step, *gradient, *rows;
    Index block_columns, row_columns;
};

// linearise.Linearisation; ``width`` is that of the tip.
struct Linearisation {
    double *costs, *wrench, *coupled, *carried, *whitened, *squares, *tip, *failed;
    Index width;
};

// evaluate.Evaluation; ``width`` is that of ``carried``.
struct Evaluation {
    double *costs, *wrench, *coupled, *carried, *corners, *whitened;
    Index width;
};

// engine.Report.
struct Report {
    double *residual_px, *mahalanobis2;
    bool* behind;
};

// A step as evaluate.evaluate takes it.
struct Step {
    const double *table, *motion, *cameras, *whitened;
};

// linearise.TileMap, and what subtract_frames takes beside it.
struct TileMap {
    Index per_tile, size, tiles;
    const Index *position, *begin, *row, *at;
};

struct FrameJacobians {
    const double *by_state, *clock;
    Index states, unknowns;
};

// substitute.Flat.
struct Factor {
    const double* values;
    const Index *at, *rows, *begin;
    Index columns, size, tip_size;
    const double* tip;
};

// layout.Seen, of so many observations.
struct Columns {
    const Index *camera, *frame, *corner;
    const double *pinhole_px, *covariance_px, *intrinsic;
    Index count;
};

// Observations in their order, and the pair of each: camera * frames + frame.
struct Sorted {
    const int32_t *order, *pair;
    int32_t frames;
};

// The passes; each stands in v2hdm.adjust.kernels under the same name.
struct Passes {
    void (*linearise)(
        Index begin, Index end, const Layout&, const Base&, const double* clock, bool by_pair, const Scratch&,
        const Linearisation&);
    void (*subtract_frames)(
        Index begin, Index end, const Layout&, const Base&, const TileMap&, const FrameJacobians&, Index* marks,
        const Scratch&, double* values);
    void (*evaluate)(
        Index begin, Index end, const Layout&, const Base&, const Step&, const Scratch&, const Evaluation&);
    void (*carry)(
        Index begin, Index end, const Layout&, const Base&, const double* by_corner, const Scratch&,
        const Evaluation&);
    Index (*lay_out)(const Columns&, const Sorted&, double line_excess, double* measured, double* root);
    void (*meet_ground)(
        Index begin, Index end, const Layout&, const double* homographies, double* corners, bool* determined);
    void (*report)(
        Index begin, Index end, const Layout&, const double* table, const double* corners, const int32_t* order,
        const double* focal, const Report&);
    void (*residuals)(
        Index begin, Index end, const Layout&, const double* table, const double* corners, double* out);
    void (*pull)(
        const Layout&, const double* table, const double* corners, const double* by_residual, double* wrench,
        double* by_corner);
    void (*couplings)(const Layout&, const Base&, const Index* corner, Index count, double* out);
    void (*forward)(const Factor&, double* out);
    void (*backward)(const Factor&, double* out);
};

// The passes for this machine's processor.
const Passes& passes();

}  // namespace v2hdm::adjust
