#include "views.h"

#include <algorithm>
#include <cmath>

#include "vector_math.h"

namespace v2hdm {
namespace {

constexpr float MOST_ODDS = 6.0f;  // log odds of paint beyond which they differ by chance only: network.py
constexpr int COLOURS = 3;         // blue, green and red

float log_light(float value, float dark) { return logarithm(most(value, 0.0f) + dark); }

// Take off the median, and scale.
void centre(float* values, float gain) {
    float ordered[VIEW_CELLS];
    std::copy(values, values + VIEW_CELLS, ordered);
    float* middle = ordered + VIEW_CELLS / 2;
    std::nth_element(ordered, middle, ordered + VIEW_CELLS);
    const float median = (*std::max_element(ordered, middle) + *middle) / 2;
    for (int cell = 0; cell < VIEW_CELLS; ++cell) values[cell] = gain * (values[cell] - median);
}

// Where points of the image lie among elements ``stride`` px apart.
void place_among(const Claims& claims, const float* points, double stride, int width, int height, Places& places) {
    const double middle = (stride - 1) / 2;
    const double offset[2] = {-middle / stride, -(claims.top + middle) / stride};
    places.place(points, 1 / stride, offset, width, height);
}

}  // namespace

Viewer::Viewer(const Source& source, const Claims& claims, const ViewGains& gains)
    : shares(static_cast<size_t>(claims.classes) * VIEW_CELLS), source_(source), claims_(claims), gains_(gains),
      samples_(VIEW_SAMPLES), cells_(VIEW_CELLS), radiance_(static_cast<size_t>(VIEW_SAMPLES) * COLOURS) {}

void Viewer::look(const float* points, const float* finer) {
    look_at_image(finer);
    ask_network(points);
    for (int cell = 0; cell < VIEW_CELLS; ++cell) {
        const float u = points[2 * cell], v = points[2 * cell + 1];
        const bool is_outside = u < 0 || u > source_.width - 1 || v < 0 || v > source_.height - 1;
        outside[cell] = is_outside ? 1.0f : 0.0f;
    }
}

void Viewer::look_at_image(const float* finer) {
    constexpr double NOTHING[2] = {0.0, 0.0};
    samples_.place(finer, 1.0, NOTHING, source_.width, source_.height);
    for (size_t n = 0; n < VIEW_SAMPLES; ++n) {
        const uint8_t* above_left = source_.image + COLOURS * static_cast<size_t>(samples_.above_left[n]);
        const uint8_t* above_right = source_.image + COLOURS * static_cast<size_t>(samples_.above_right[n]);
        const uint8_t* below_left = source_.image + COLOURS * static_cast<size_t>(samples_.below_left[n]);
        const uint8_t* below_right = source_.image + COLOURS * static_cast<size_t>(samples_.below_right[n]);
        for (int c = 0; c < COLOURS; ++c) {
            const float code = samples_.between(n, above_left[c], above_right[c], below_left[c], below_right[c]);
            radiance_[COLOURS * n + c] = source_.radiance[std::lrint(code)];
        }
    }
    constexpr int ROW = VIEW_SIZE * VIEW_FINER * COLOURS;  // values of a row of samples
    float red[VIEW_CELLS];
    for (int i = 0; i < VIEW_SIZE; ++i) {
        for (int j = 0; j < VIEW_SIZE; ++j) {
            const float* first = radiance_.data() + static_cast<size_t>(VIEW_FINER * i) * ROW + VIEW_FINER * COLOURS * j;
            float light[COLOURS];
            for (int c = 0; c < COLOURS; ++c) {
                light[c] = (first[c] + first[COLOURS + c] + first[ROW + c] + first[ROW + COLOURS + c]) / 4;
            }
            const int cell = VIEW_SIZE * i + j;
            log_grey[cell] = source_.grey[0] * light[0] + source_.grey[1] * light[1] + source_.grey[2] * light[2];
            blueness[cell] = light[0];
            red[cell] = light[2];
        }
    }
    for (int cell = 0; cell < VIEW_CELLS; ++cell) {
        log_grey[cell] = log_light(log_grey[cell], source_.dark);
        blueness[cell] = log_light(blueness[cell], source_.dark) - log_light(red[cell], source_.dark);
    }
    centre(log_grey, gains_.grey);
    centre(blueness, gains_.colour);
}

void Viewer::ask_network(const float* points) {
    place_among(claims_, points, claims_.stride, claims_.width, claims_.height, cells_);
    cells_.read(claims_.paint, paint_odds);
    float most_odds[VIEW_CELLS], total[VIEW_CELLS];
    for (int cell = 0; cell < VIEW_CELLS; ++cell) {
        paint_odds[cell] = gains_.odds * least(most(paint_odds[cell], -MOST_ODDS), MOST_ODDS);
        most_odds[cell] = -3e38f;
        total[cell] = symbol_share[cell] = 0.0f;
    }
    const double kind_stride = claims_.stride * claims_.kind_scale;
    place_among(claims_, points, kind_stride, claims_.kind_width, claims_.kind_height, cells_);
    const size_t plane = static_cast<size_t>(claims_.kind_height) * claims_.kind_width;
    for (int k = 0; k < claims_.classes; ++k) {
        float* share = shares.data() + static_cast<size_t>(k) * VIEW_CELLS;
        cells_.read(claims_.kinds + k * plane, share);
        for (int cell = 0; cell < VIEW_CELLS; ++cell) most_odds[cell] = most(share[cell], most_odds[cell]);
    }
    for (int k = 0; k < claims_.classes; ++k) {
        float* share = shares.data() + static_cast<size_t>(k) * VIEW_CELLS;
        for (int cell = 0; cell < VIEW_CELLS; ++cell) share[cell] = exponential(share[cell] - most_odds[cell]);
        for (int cell = 0; cell < VIEW_CELLS; ++cell) total[cell] += share[cell];
    }
    for (int cell = 0; cell < VIEW_CELLS; ++cell) total[cell] = 1 / total[cell];
    for (int k = 0; k < claims_.classes; ++k) {
        float* share = shares.data() + static_cast<size_t>(k) * VIEW_CELLS;
        for (int cell = 0; cell < VIEW_CELLS; ++cell) share[cell] *= total[cell];
        if (!claims_.symbol[k]) continue;
        for (int cell = 0; cell < VIEW_CELLS; ++cell) symbol_share[cell] += share[cell];
    }
    const float* line = shares.data() + static_cast<size_t>(claims_.line) * VIEW_CELLS;
    std::copy(line, line + VIEW_CELLS, line_share);
}

}  // namespace v2hdm
