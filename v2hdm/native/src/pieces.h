// Connected pieces of paint; twin of v2hdm.detection.quads.blobs._find_pieces.
#pragma once

#include <cstdint>
#include <vector>

#include "components.h"
#include "paint.h"

namespace v2hdm {

// From which log odds paint is sure, and from which it is doubtful.
struct PaintRules {
    float sure, doubtful;
    int least_cells;  // elements of a part that counts
};

// What is said of pieces, in order, and of areas of doubtful paint, numbered from 1 on.
struct Pieces {
    std::vector<Component> pieces;
    std::vector<int32_t> sure_parts;  // parts of sure paint of each piece
    std::vector<int32_t> area;        // in which each lies
    std::vector<Component> areas;
};

// Find the pieces of paint that reach a row of a framed level (height, width).
//
// Write the number of each element's piece, from 1 on, and that of its area; holes belong to what is around them.
Pieces find_pieces(
    const float* level, int height, int width, double least_row, const PaintRules& rules, int16_t* piece, int16_t* area);

}  // namespace v2hdm
