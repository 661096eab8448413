// Values between the elements of an image or plane, as OpenCV's remap has them; what lies outside is as the border.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace v2hdm {

// Where points lie among elements: the left of the two above each, and those right of it, below and both.
struct Places {
    std::vector<int32_t> above_left, above_right, below_left, below_right;
    std::vector<float> across, down;  // from the left and from above, in steps

    explicit Places(size_t count)
        : above_left(count), above_right(count), below_left(count), below_right(count), across(count), down(count) {}

    // Point n (x, y) lies at ``gain`` (x, y) + ``offset`` in a plane; one that is nowhere is at the border.
    void place(const float* points, double gain, const double offset[2], int width, int height) {
        const float last_column = static_cast<float>(width - 1), last_row = static_cast<float>(height - 1);
        for (size_t n = 0; n < across.size(); ++n) {
            const float u = within(static_cast<float>(points[2 * n] * gain + offset[0]), last_column);
            const float v = within(static_cast<float>(points[2 * n + 1] * gain + offset[1]), last_row);
            const int32_t column = static_cast<int32_t>(u), row = static_cast<int32_t>(v);
            const int32_t right = column + 1 < width ? 1 : 0, below = row + 1 < height ? width : 0;
            above_left[n] = row * width + column;
            above_right[n] = above_left[n] + right;
            below_left[n] = above_left[n] + below;
            below_right[n] = above_right[n] + below;
            across[n] = u - static_cast<float>(column);
            down[n] = v - static_cast<float>(row);
        }
    }

    // The value at point n between four.
    float between(size_t n, float above_left, float above_right, float below_left, float below_right) const {
        const float upper = above_left + across[n] * (above_right - above_left);
        const float lower = below_left + across[n] * (below_right - below_left);
        return upper + down[n] * (lower - upper);
    }

    // The values of a plane at all points.
    void read(const float* plane, float* values) const {
        for (size_t n = 0; n < across.size(); ++n) {
            values[n] = between(n, plane[above_left[n]], plane[above_right[n]], plane[below_left[n]], plane[below_right[n]]);
        }
    }

  private:
    static float within(float at, float last) {
        const float positive = at > 0.0f ? at : 0.0f;
        return positive < last ? positive : last;
    }
};

}  // namespace v2hdm
