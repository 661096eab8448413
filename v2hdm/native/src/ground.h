// Images on tiles of the ground; twin of the loops over pixels in v2hdm.mosaic.
#pragma once

#include <cstddef>
#include <cstdint>

namespace v2hdm {

constexpr int TILE = 64;  // side of a tile, px of the canvas: warp.TILE_PX
constexpr int TILE_CELLS = TILE * TILE;
constexpr int SUMS = 5;  // weighted colours, weights and opacities: blend._Sums

// Where nodes of tiles (T, side, side) lie in an image: warp.Nodes.
struct GroundNodes {
    const double *x_px, *y_px, *third;
    size_t tiles;
    int side;
};

// An image's pixels (height, width, channels), 0 outside of it.
struct GroundImage {
    const uint8_t* pixels;
    int height, width, channels;
};

// How much an image counts: blend._Blend._contribution.
struct GroundCounts {
    const float* shown;  // how far it shows the ground, at nodes (T, side, side)
    float volume;        // of its density, times the third power of the third coordinate
    float fullness;      // what a density is multiplied by to be 1 where it is full
    float finest;        // largest density that counts, so multiplied
};

// Add what an image shows to the sums (5, slots, TILE, TILE) of tiles, each in its slot.
void add_image(
    const GroundNodes& nodes, const GroundImage& colours, const GroundImage& alpha, const GroundCounts& counts,
    const int64_t* slot, size_t slots, float* sums);

// Write the mean colours and the alpha (slots, TILE, TILE, 4) of sums (5, slots, TILE, TILE).
void mean_of(const float* sums, size_t slots, uint8_t* rgba);

// Write an image's grey values at the pixels of tiles (T, TILE, TILE), and whether a mask is set there.
void look_at_ground(
    const GroundNodes& nodes, const GroundImage& grey, const GroundImage& mask, float* values, bool* is_set);

}  // namespace v2hdm
