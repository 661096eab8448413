#include "pieces.h"

#include <algorithm>

namespace v2hdm {
namespace {

constexpr int MOST_NUMBER = 32767;  // of 16 bits; what comes after is left out
constexpr int LEAST_CONTOUR = 3;    // a piece of no more elements must reach so far to be worth an outline

std::vector<uint8_t> above(const float* level, size_t size, float least) {
    std::vector<uint8_t> mask(size);
    for (size_t n = 0; n < size; ++n) mask[n] = level[n] > least ? 1 : 0;
    return mask;
}

void fill(const Run& run, int width, int16_t number, int16_t* map) {
    int16_t* row = map + static_cast<size_t>(run.row) * width;
    std::fill(row + run.first, row + run.last, number);
}

// Whether OpenCV's contour of it has four points or more, as a quadrilateral needs.
bool has_contour(const Component& piece) {
    const int extent = std::max(piece.right - piece.left, piece.bottom - piece.top);
    return piece.elements > LEAST_CONTOUR || extent >= LEAST_CONTOUR;
}

// Set every element that the frame does not reach past paint: the paint, and the holes in it.
void close_holes(std::vector<uint8_t>& mask, int height, int width) {
    std::vector<uint8_t> empty(mask.size());
    for (size_t n = 0; n < mask.size(); ++n) empty[n] = 1 - mask[n];
    const Components ground(empty.data(), height, width, false);
    // The frame has the first element of all.
    for (const Run& run : ground.runs) {
        if (run.component == 0) continue;
        std::fill_n(mask.begin() + static_cast<size_t>(run.row) * width + run.first, run.last - run.first, uint8_t{1});
    }
}

void number_pieces(const Components& found, int width, double least_row, int16_t* map, Pieces& pieces) {
    std::vector<int16_t> number(found.components.size());
    // The last comes first, as of OpenCV's contours.
    for (size_t k = found.components.size(); k-- > 0;) {
        const Component& piece = found.components[k];
        if (!has_contour(piece) || piece.bottom < least_row || pieces.pieces.size() >= MOST_NUMBER) continue;
        pieces.pieces.push_back(piece);
        number[k] = static_cast<int16_t>(pieces.pieces.size());
    }
    for (const Run& run : found.runs) fill(run, width, number[run.component], map);
}

void find_areas(const float* level, int height, int width, float doubtful, int16_t* map, Pieces& pieces) {
    std::vector<uint8_t> mask = above(level, static_cast<size_t>(height) * width, doubtful);
    for (int i = 0; i < height; ++i) {
        uint8_t* row = mask.data() + static_cast<size_t>(i) * width;
        if (i == 0 || i == height - 1) std::fill(row, row + width, uint8_t{0});
        row[0] = row[width - 1] = 0;
    }
    const Components found(mask.data(), height, width, true);
    pieces.areas = found.components;
    for (const Run& run : found.runs) {
        const int number = run.component + 1;
        if (number <= MOST_NUMBER) fill(run, width, static_cast<int16_t>(number), map);
    }
    for (const Component& piece : pieces.pieces) {
        pieces.area.push_back(map[static_cast<size_t>(piece.first_row) * width + piece.first_column]);
    }
}

void count_sure_parts(
    const float* level, int height, int width, const PaintRules& rules, const int16_t* map, Pieces& pieces) {
    std::vector<uint8_t> mask = above(level, static_cast<size_t>(height) * width, rules.sure);
    for (size_t n = 0; n < mask.size(); ++n) mask[n] &= map[n] > 0 ? 1 : 0;
    pieces.sure_parts.assign(pieces.pieces.size(), 0);
    for (const Component& part : Components(mask.data(), height, width, true).components) {
        if (part.elements < rules.least_cells) continue;
        pieces.sure_parts[map[static_cast<size_t>(part.first_row) * width + part.first_column] - 1] += 1;
    }
}

}  // namespace

Pieces find_pieces(
    const float* level, int height, int width, double least_row, const PaintRules& rules, int16_t* piece, int16_t* area) {
    std::vector<uint8_t> mask = above(level, static_cast<size_t>(height) * width, 0.0f);
    close_holes(mask, height, width);
    Pieces pieces;
    number_pieces(Components(mask.data(), height, width, true), width, least_row, piece, pieces);
    find_areas(level, height, width, rules.doubtful, area, pieces);
    count_sure_parts(level, height, width, rules, piece, pieces);
    return pieces;
}

}  // namespace v2hdm
