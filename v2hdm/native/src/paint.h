// Pieces of paint; twin of v2hdm.detection.quads.blobs.
#pragma once

#include <cstdint>
#include <vector>

namespace v2hdm {

// A map of pieces (height, width), 0 for none, and the level of paint there.
struct PieceMap {
    const int16_t* piece;
    const float* level;
    int height, width;
};

// Points (x, y, x, y, ...) of the outlines of ``count`` pieces, where the level falls to zero beside each.
std::vector<std::vector<double>> outlines(const PieceMap& map, int count);

// Where a rectangle of a map begins, and where it ends.
struct Box {
    int first_row, first_column, last_row, last_column;
};

// The level in a box of a map, positive in one piece only; blobs._signed.
void sign(const PieceMap& map, int piece, const Box& box, float* levels);

// Log odds of classes at elements that are ``scale`` times as far apart as those of the paint.
struct Kinds {
    const float* odds;  // (classes, height, width)
    int classes, height, width;
    double scale;
    int first_row, first_column;  // of the map, in elements of the paint
};

// What the network says of each of ``count`` pieces; arrays are (count) and (count, classes).
struct Tally {
    std::vector<int64_t> cells, best;        // elements; those of which each class is the likeliest
    std::vector<double> certainty, probability;  // sums over the elements
};

Tally tally(const PieceMap& map, const Kinds& kinds, int count);

}  // namespace v2hdm
