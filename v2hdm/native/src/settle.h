// Gauss-Newton on quadrilaterals; twin of v2hdm.detection.quads.state, which explains the model.
#pragma once

#include <cstdint>

#if defined(__x86_64__) && defined(__GNUC__)
#define V2HDM_AVX2
#endif

namespace v2hdm {

constexpr int KNOTS = 6;                        // of the light along a marking
constexpr int BLUR = 8;                         // places among the unknowns; the sides' are before it
constexpr int CONTRAST = BLUR + 1;
constexpr int LIGHT = CONTRAST + 1;
constexpr int SLOPE = LIGHT + KNOTS;
constexpr int UNKNOWNS = SLOPE + 1;

// The constants of state.py, robust.py and coverage.py, by their names there.
struct FitRules {
    double least_blur_px, most_blur_px, blur_sigma_px;
    double contrast, contrast_sigma, most_contrast, light_step;
    double most_step, most_contrast_step, settled_px, insignificant, held;
    double sigma_of_mad, min_scatter, shared_pixels, cauchy, max_correlation, paint_sigma;
    double roughness[KNOTS][KNOTS];
};

// The pixels about one marking, N of them in rows that are ``stride`` apart; lattice.Lattice says what they are.
struct Pixels {
    int count, stride, neighbour_rows;
    const float *points, *values, *use, *of_side, *hats, *across;
    const bool* limited;
    const int64_t* neighbours;
    const float* paint;  // null in a fit
};

// Views of one marking's unknowns, and of what is expected of them; state.State says what they are.
struct Unknowns {
    double *corners, *blur_px, *contrast, *expected_contrast, *light, *slope;
    const double *outline, *outline_sigma_px, *closure, *gap;
    double expected_blur_px;
};

// Views of one marking's equations; state.System says what they are.
struct Equations {
    double *information, *scatter, *inliers, *side_step, *decrement;
};

// The table of Owen's T; coverage.owen_table says what it is.
struct OwenTable {
    const float* values;
    int rows, columns;
    float cells_per_blur, reach;
};

using Settle = void(
    const Pixels& pixels,
    const OwenTable& table,
    const FitRules& rules,
    int steps,
    double scatter,
    Unknowns& unknowns,
    Equations& equations);

// At most ``steps`` steps, the robust scale at the first ``scatter`` or more, and half of that at each next one.
Settle settle;

// The same for any processor, and for those with AVX2.
Settle settle_anywhere, settle_avx2;

}  // namespace v2hdm
