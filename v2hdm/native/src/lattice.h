// The pixels that a fit looks at; twin of v2hdm.detection.quads.lattice and of patch.Patches.look.
#pragma once

#include <cstdint>
#include <vector>

#include "lens.h"

namespace v2hdm {

// An image, whose paint each element of the network's output is, and a camera's lens; patch.Source says more.
struct Source {
    const uint8_t* image;  // BGR
    int width, height;
    const int16_t* owner;
    int owner_width, owner_height, top, stride;
    const float *radiance, *logs;  // of the 256 codes
    int clipped;                   // least code of a sensor at its limit
    float dark;
    float grey[3];        // weights of blue, green and red
    LensTable lens;
};

// A marking: its frame, its sides, and the axes of its light.
struct Marking {
    int64_t first_piece, last_piece;
    const double *middle, *scale;  // patch.LensFrames
    const float *outward;          // (4, 3) to distances outside of the sides
    const float *axes;             // (2, 3) to places along and across, -1 to 1
};

// Where one marking's arrays begin; rows are ``stride`` apart.
struct LatticeRows {
    int stride;
    float *points, *values, *use, *of_side, *hats, *across;
    bool* limited;
    double* clipped;
};

constexpr int HATS = 6;  // knots of the light

// Look at n pixels, with the choice of the colour in which inside and outside differ most.
void look(
    const Source& source,
    const Marking& marking,
    int count,
    const int64_t* u,
    const int64_t* v,
    double grey_first,
    LatticeRows& rows);

// The places that may be looked at in one marking's box, along both axes, and the rows of its sides.
struct Band {
    int columns, rows;           // places within the box
    const int64_t *column, *row; // px from the first pixel of the box
    const bool *near_right, *near_below;  // whether the next place is as near as any
    const float* outward;        // (4, 3)
    float outside_px, inside_px; // how far from a side pixels are looked at
    int most;                    // pixels of which more are thinned
};

// The pixels in a band: places in its box, and the places in the list of the next ones right and below, or 0.
struct Chosen {
    std::vector<int64_t> column, row, right, below;
};

Chosen choose(const Band& band);

}  // namespace v2hdm
