#include "ground.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "vector_math.h"

namespace v2hdm {
namespace {

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

// Places in an image of a row of pixels of a tile, each between four of the image's own.
class Places {
  public:
    int column[TILE], row[TILE];  // of the upper left one of the four
    float across[TILE], down[TILE];
    bool is_there[TILE];  // whether any of the four is in the image

    // Find those of a row that count so far; false where none is there. A share of 0 or less counts nothing.
    bool find(const GroundImage& image, const Rows& rows, const float share[TILE]) {
        const float width = static_cast<float>(image.width), height = static_cast<float>(image.height);
        int count = 0;
        for (int k = 0; k < TILE; ++k) {
            float x_px = rows.x_px[k], y_px = rows.y_px[k];
            const bool is_near = (share[k] > 0) & (rows.nearness[k] > 0) & (x_px > -1) & (y_px > -1) & (x_px < width)
                & (y_px < height);
            x_px = is_near ? x_px : 0;
            y_px = is_near ? y_px : 0;
            column[k] = floor_of(x_px);
            row[k] = floor_of(y_px);
            across[k] = x_px - column[k];
            down[k] = y_px - row[k];
            is_there[k] = is_near;
            count += is_near;
        }
        return count > 0;
    }

  private:
    static int floor_of(float at) {
        const int whole = static_cast<int>(at);
        return whole - (whole > at);
    }
};

// The four pixels of an image about each of such places, and what lies linearly between them.
template <int CHANNELS>
class Around {
  public:
    explicit Around(const GroundImage& of) : image(of) {}

    // Take them where a place is there.
    void take(const Places& places) {
        const size_t line = static_cast<size_t>(image.width) * CHANNELS;
        for (int k = 0; k < TILE; ++k) {
            if (!places.is_there[k]) continue;
            const int column = places.column[k], row = places.row[k];
            const bool is_within = column >= 0 && row >= 0 && column + 1 < image.width && row + 1 < image.height;
            if (is_within) {
                const uint8_t* upper = image.pixels + row * line + static_cast<size_t>(column) * CHANNELS;
                for (int channel = 0; channel < CHANNELS; ++channel) {
                    pixels[channel][0][k] = upper[channel];
                    pixels[channel][1][k] = upper[channel + CHANNELS];
                    pixels[channel][2][k] = upper[channel + line];
                    pixels[channel][3][k] = upper[channel + line + CHANNELS];
                }
            } else {
                for (int channel = 0; channel < CHANNELS; ++channel) {
                    for (int n = 0; n < 4; ++n) pixels[channel][n][k] = pixel(column + n % 2, row + n / 2, channel);
                }
            }
        }
    }

    // Write the values of a channel; what they are where no place is there means nothing.
    void between(const Places& places, int channel, float values[TILE]) const {
        const auto& of = pixels[channel];
        for (int k = 0; k < TILE; ++k) {
            const float upper = of[0][k] + places.across[k] * (of[1][k] - of[0][k]);
            const float lower = of[2][k] + places.across[k] * (of[3][k] - of[2][k]);
            values[k] = upper + places.down[k] * (lower - upper);
        }
    }

  private:
    const GroundImage& image;
    uint8_t pixels[CHANNELS][4][TILE] = {};  // upper left, upper right, lower left, lower right

    uint8_t pixel(int column, int row, int channel) const {
        if (column < 0 || row < 0 || column >= image.width || row >= image.height) return 0;
        return image.pixels[(static_cast<size_t>(row) * image.width + column) * CHANNELS + channel];
    }
};

// To the nearest whole number, of one that is not negative: compilers make vector instructions of it.
float whole_of(float value) { return static_cast<float>(static_cast<int>(value + 0.5f)); }

}  // namespace

void add_image(
    const GroundNodes& nodes, const GroundImage& colours, const GroundImage& alpha, const GroundCounts& counts,
    const int64_t* slot, size_t slots, float* sums) {
    Rows rows(nodes);
    Between between(nodes.side);
    Places places;
    Around<1> alphas(alpha);
    Around<3> pixels(colours);
    float share[TILE], weight[TILE], values[TILE];
    const size_t plane = slots * TILE_CELLS;
    for (size_t tile = 0; tile < nodes.tiles; ++tile) {
        const float* at_nodes = counts.shown + tile * nodes.side * nodes.side;
        if (std::all_of(at_nodes, at_nodes + nodes.side * nodes.side, [](float value) { return value <= 0.5f; })) continue;
        rows.take(tile);
        between.take([&](int row, int column) { return at_nodes[row * nodes.side + column]; });
        for (int row = 0; row < TILE; ++row) {
            rows.to(row);
            between.write(row, share);
            for (int k = 0; k < TILE; ++k) share[k] = 2 * share[k] - 1;  // consensus.share_of
            if (!places.find(alpha, rows, share)) continue;
            for (int k = 0; k < TILE; ++k) share[k] = places.is_there[k] ? share[k] : 0;
            float* sum = sums + slot[tile] * TILE_CELLS + row * TILE;
            alphas.take(places);
            alphas.between(places, 0, values);
            for (int k = 0; k < TILE; ++k) {
                const float trust = whole_of(values[k]) * (1 / 255.0f) * share[k];
                const float density = counts.volume * rows.nearness[k] * rows.nearness[k] * rows.nearness[k];
                const float fineness = least(density * counts.fullness, counts.finest);
                weight[k] = trust * (fineness * fineness);
                sum[3 * plane + k] += weight[k];
                sum[4 * plane + k] += trust * least(fineness, 1.0f);
            }
            pixels.take(places);
            for (int channel = 0; channel < 3; ++channel) {
                pixels.between(places, channel, values);
                for (int k = 0; k < TILE; ++k) sum[channel * plane + k] += whole_of(values[k]) * weight[k];
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
    Places places;
    Around<1> greys(grey), masks(mask);
    float masked[TILE], share[TILE];
    std::fill_n(share, TILE, 1.0f);
    for (size_t tile = 0; tile < nodes.tiles; ++tile) {
        rows.take(tile);
        for (int row = 0; row < TILE; ++row, values += TILE, is_set += TILE) {
            rows.to(row);
            if (!places.find(grey, rows, share)) {
                std::fill_n(values, TILE, 0.0f);
                std::fill_n(is_set, TILE, false);
                continue;
            }
            greys.take(places);
            greys.between(places, 0, values);
            masks.take(places);
            masks.between(places, 0, masked);
            for (int k = 0; k < TILE; ++k) {
                values[k] = places.is_there[k] ? values[k] : 0;
                is_set[k] = places.is_there[k] && whole_of(masked[k]) > 0;
            }
        }
    }
}

}  // namespace v2hdm
