#include "ground.h"

#include <algorithm>
#include <cmath>
#include <vector>

namespace v2hdm {
namespace {

// A place between four pixels of an image.
class Place {
  public:
    // False where none of the four is in the image.
    bool find(const GroundImage& image, float x_px, float y_px) {
        const bool is_near = x_px > -1 && y_px > -1 && x_px < image.width && y_px < image.height;
        if (!is_near) return false;
        column = floor_of(x_px);
        row = floor_of(y_px);
        across = x_px - column;
        down = y_px - row;
        return true;
    }

    // The value of a channel, linear between the four.
    float value(const GroundImage& image, int channel) const {
        const float upper = between(image, row, channel), lower = between(image, row + 1, channel);
        return upper + down * (lower - upper);
    }

  private:
    int column, row;
    float across, down;

    static int floor_of(float at) {
        const int whole = static_cast<int>(at);
        return whole > at ? whole - 1 : whole;
    }

    float between(const GroundImage& image, int of_row, int channel) const {
        if (of_row < 0 || of_row >= image.height) return 0;
        const int64_t first = static_cast<int64_t>(of_row) * image.width + column;
        const uint8_t* pixel = image.pixels + first * image.channels + channel;
        const float left = column >= 0 ? pixel[0] : 0;
        const float right = column + 1 < image.width ? pixel[image.channels] : 0;
        return left + across * (right - left);
    }
};

// As OpenCV rounds.
uint8_t rounded(float value) { return static_cast<uint8_t>(std::lrint(value)); }

// Values of nodes at the pixels of their tile, row by row: warp.Warp.between.
class Between {
  public:
    explicit Between(int side) : step(TILE / (side - 1)), lines(static_cast<size_t>(side) * TILE) {}

    // Take node (row, column) of the next tile from a function.
    template <typename Value>
    void take(const Value& value) {
        for (int row = 0; row * step <= TILE; ++row) {
            float* line = lines.data() + static_cast<size_t>(row) * TILE;
            for (int node = 0; node * step < TILE; ++node) {
                const float left = value(row, node), right = value(row, node + 1);
                for (int k = 0; k < step; ++k) {
                    const float share = static_cast<float>(k) / step;
                    line[node * step + k] = left * (1 - share) + right * share;
                }
            }
        }
    }

    // Write the values of a row of pixels.
    void write(int row, float values[TILE]) const {
        const float share = static_cast<float>(row % step) / step;
        const float *upper = lines.data() + static_cast<size_t>(row / step) * TILE, *lower = upper + TILE;
        for (int k = 0; k < TILE; ++k) values[k] = upper[k] * (1 - share) + lower[k] * share;
    }

  private:
    int step;
    std::vector<float> lines;  // of nodes, each (TILE)
};

// Where the pixels of tiles lie in an image, row by row: warp.Warp.pixels.
class Rows {
  public:
    float x_px[TILE], y_px[TILE];
    float nearness[TILE];  // one over the third coordinate, 0 behind the camera

    explicit Rows(const GroundNodes& all) : nodes(all), x(all.side), y(all.side), third(all.side) {}

    void take(size_t tile) {
        const auto at = [&](int row, int column) { return (tile * nodes.side + row) * nodes.side + column; };
        const auto times_third = [&](const double* place_px) {
            return [=](int row, int column) {
                const size_t node = at(row, column);
                return static_cast<float>(place_px[node] * nodes.third[node]);
            };
        };
        x.take(times_third(nodes.x_px));
        y.take(times_third(nodes.y_px));
        third.take([&](int row, int column) { return static_cast<float>(nodes.third[at(row, column)]); });
    }

    void to(int row) {
        third.write(row, nearness);
        x.write(row, x_px);
        y.write(row, y_px);
        for (int k = 0; k < TILE; ++k) {
            nearness[k] = nearness[k] > 0 ? 1 / nearness[k] : 0;
            x_px[k] *= nearness[k];
            y_px[k] *= nearness[k];
        }
    }

  private:
    const GroundNodes& nodes;
    Between x, y, third;
};

}  // namespace

void add_image(
    const GroundNodes& nodes, const GroundImage& colours, const GroundImage& alpha, const GroundCounts& counts,
    const int64_t* slot, size_t slots, float* sums) {
    Rows rows(nodes);
    Between between(nodes.side);
    float shown[TILE];
    const size_t plane = slots * TILE_CELLS;
    for (size_t tile = 0; tile < nodes.tiles; ++tile) {
        const float* at_nodes = counts.shown + tile * nodes.side * nodes.side;
        if (std::all_of(at_nodes, at_nodes + nodes.side * nodes.side, [](float value) { return value <= 0.5f; })) continue;
        rows.take(tile);
        between.take([&](int row, int column) { return at_nodes[row * nodes.side + column]; });
        for (int row = 0; row < TILE; ++row) {
            rows.to(row);
            between.write(row, shown);
            float* sum = sums + slot[tile] * TILE_CELLS + row * TILE;
            for (int k = 0; k < TILE; ++k) {
                Place place;
                const float share = 2 * shown[k] - 1;  // consensus.share_of
                const bool is_there = share > 0 && rows.nearness[k] > 0 && place.find(alpha, rows.x_px[k], rows.y_px[k]);
                if (!is_there) continue;
                const float trust = rounded(place.value(alpha, 0)) * (1 / 255.0f) * share;
                const float density = counts.volume * rows.nearness[k] * rows.nearness[k] * rows.nearness[k];
                const float fineness = std::min(density * counts.fullness, counts.finest);
                const float weight = trust * (fineness * fineness);
                for (int channel = 0; channel < 3; ++channel) {
                    sum[channel * plane + k] += rounded(place.value(colours, channel)) * weight;
                }
                sum[3 * plane + k] += weight;
                sum[4 * plane + k] += trust * std::min(fineness, 1.0f);
            }
        }
    }
}

void mean_of(const float* sums, size_t slots, uint8_t* rgba) {
    const size_t plane = slots * TILE_CELLS;
    for (size_t k = 0; k < plane; ++k, rgba += 4) {
        const float weight = sums[3 * plane + k] > 0 ? sums[3 * plane + k] : 1;
        for (int channel = 0; channel < 3; ++channel) rgba[channel] = rounded(sums[(2 - channel) * plane + k] / weight);
        rgba[3] = rounded(std::min(255 * sums[4 * plane + k], 255.0f));
    }
}

void look_at_ground(
    const GroundNodes& nodes, const GroundImage& grey, const GroundImage& mask, float* values, bool* is_set) {
    Rows rows(nodes);
    for (size_t tile = 0; tile < nodes.tiles; ++tile) {
        rows.take(tile);
        for (int row = 0; row < TILE; ++row, values += TILE, is_set += TILE) {
            rows.to(row);
            for (int k = 0; k < TILE; ++k) {
                Place place;
                const bool is_there = rows.nearness[k] > 0 && place.find(grey, rows.x_px[k], rows.y_px[k]);
                values[k] = is_there ? place.value(grey, 0) : 0;
                is_set[k] = is_there && rounded(place.value(mask, 0)) > 0;
            }
        }
    }
}

}  // namespace v2hdm
