// A quadrilateral of an image; twin of v2hdm.geometry.planar.Quad.
#pragma once

#include <cmath>

namespace v2hdm {
// Of no file but the one that includes it, as each may be compiled for another processor.
namespace {

constexpr int SIDES = 4;  // sides of a quadrilateral, and corners

struct Quad {
    double corner[SIDES][2];
    double tangent[SIDES][2];  // unit direction of each side
    double normal[SIDES][2];   // unit normal of each side, outwards
    double length[SIDES];

    explicit Quad(const double* corners) {
        for (int c = 0; c < SIDES; ++c) {
            corner[c][0] = corners[2 * c];
            corner[c][1] = corners[2 * c + 1];
        }
        for (int c = 0; c < SIDES; ++c) {
            const double* next = corner[(c + 1) % SIDES];
            const double along[2] = {next[0] - corner[c][0], next[1] - corner[c][1]};
            length[c] = std::hypot(along[0], along[1]);
            const double size = length[c] > 1e-9 ? length[c] : 1e-9;
            tangent[c][0] = along[0] / size;
            tangent[c][1] = along[1] / size;
            normal[c][0] = -tangent[c][1];
            normal[c][1] = tangent[c][0];
        }
    }

    // How a corner moves with its own side's start, and with the end of the side before.
    void slides(int c, double by_start[2], double by_end[2]) const {
        constexpr double LEAST_SINE = 1e-3;  // as of planar.py
        const double* before = tangent[(c + SIDES - 1) % SIDES];
        const double* own = tangent[c];
        double sine = before[0] * own[1] - before[1] * own[0];
        if (std::abs(sine) < LEAST_SINE) sine = -LEAST_SINE;
        for (int axis = 0; axis < 2; ++axis) {
            by_start[axis] = -before[axis] / sine;
            by_end[axis] = own[axis] / sine;
        }
    }

    // Write the corners that follow if the sides' starts and ends, 8, move along the normals.
    void moved(const double* by_side, double* corners) const {
        for (int c = 0; c < SIDES; ++c) {
            double by_start[2], by_end[2];
            slides(c, by_start, by_end);
            const double start_px = by_side[c];
            const double end_px = by_side[SIDES + (c + SIDES - 1) % SIDES];
            for (int axis = 0; axis < 2; ++axis) {
                corners[2 * c + axis] = corner[c][axis] + by_start[axis] * start_px + by_end[axis] * end_px;
            }
        }
    }
};

}  // namespace
}  // namespace v2hdm
