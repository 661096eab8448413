#include "lanes.h"

#include <algorithm>
#include <cmath>
#include <tuple>

namespace v2hdm {
namespace {

// An unfinished line: rows, columns and indices of its crossings, from near to far.
struct Chain {
    std::vector<double> v_px, u_px;
    std::vector<int64_t> index;
    double slope = 0.0;  // columns per row over the last points; none with a single one

    Chain(double v, double u, int64_t k) : v_px{v}, u_px{u}, index{k} {}

    void add(double v, double u, int64_t k, int slope_points) {
        v_px.push_back(v);
        u_px.push_back(u);
        index.push_back(k);
        const size_t first = v_px.size() - std::min<size_t>(v_px.size(), static_cast<size_t>(slope_points));
        slope = (u - u_px[first]) / (v_px[first] - v);
    }
};

struct Pair {
    double off;
    size_t chain, crossing;

    bool operator<(const Pair& other) const {
        return std::tie(off, chain, crossing) < std::tie(other.off, other.chain, other.crossing);
    }
};

// Give each crossing of a row to the chain that it fits best; the rest start new chains.
void extend(std::vector<Chain>& chains, double row_px, const double* u_px, int64_t first, int count, const ChainRules& rules) {
    std::vector<Pair> pairs;
    for (size_t c = 0; c < chains.size(); ++c) {
        const Chain& chain = chains[c];
        const double ahead_px = chain.v_px.back() - row_px;
        double expected = chain.u_px.back(), gate = rules.max_slope * ahead_px;
        if (chain.v_px.size() > 1) {
            const bool is_young = chain.v_px.size() < static_cast<size_t>(rules.slope_points);
            expected += chain.slope * ahead_px;
            gate = rules.gate_px * (is_young ? rules.young : 1.0) * (1 + rules.widening * (ahead_px - rules.row_step_px));
        }
        for (int p = 0; p < count; ++p) {
            const double off = std::abs(u_px[p] - expected);
            if (off <= gate) pairs.push_back({off / gate, c, static_cast<size_t>(p)});
        }
    }
    std::sort(pairs.begin(), pairs.end());
    std::vector<bool> extended(chains.size()), linked(static_cast<size_t>(count));
    for (const Pair& pair : pairs) {
        if (extended[pair.chain] || linked[pair.crossing]) continue;
        chains[pair.chain].add(row_px, u_px[pair.crossing], first + static_cast<int64_t>(pair.crossing), rules.slope_points);
        extended[pair.chain] = linked[pair.crossing] = true;
    }
    for (int p = 0; p < count; ++p) {
        if (!linked[static_cast<size_t>(p)]) chains.emplace_back(row_px, u_px[p], first + p);
    }
}

double median(std::vector<double>& values) {
    const size_t half = values.size() / 2;
    std::nth_element(values.begin(), values.begin() + half, values.end());
    if (values.size() % 2 == 1) return values[half];
    return (values[half] + *std::max_element(values.begin(), values.begin() + half)) / 2;
}

}  // namespace

std::vector<std::vector<int64_t>> find_chains(const double* u_px, const double* v_px, int count, const ChainRules& rules) {
    std::vector<Chain> open;
    std::vector<std::vector<int64_t>> done;
    const auto finish = [&](Chain& chain) {
        if (chain.index.size() >= static_cast<size_t>(rules.min_chain)) done.push_back(std::move(chain.index));
    };
    for (int begin = 0, end; begin < count; begin = end) {
        const double row_px = v_px[begin];
        for (end = begin + 1; end < count && v_px[end] == row_px;) ++end;
        std::vector<Chain> near;
        for (Chain& chain : open) {
            if (chain.v_px.back() - row_px > rules.max_gap_px) {
                finish(chain);
            } else {
                near.push_back(std::move(chain));
            }
        }
        open = std::move(near);
        extend(open, row_px, u_px + begin, begin, end - begin, rules);
    }
    for (Chain& chain : open) finish(chain);
    return done;
}

std::vector<std::vector<Run>> branches(const float* level, int height, int width, int least) {
    std::vector<std::vector<Run>> open, closed;
    const auto close = [&](std::vector<Run>& chain) {
        if (chain.size() >= static_cast<size_t>(least)) closed.push_back(std::move(chain));
    };
    for (int i = 0; i < height; ++i) {
        const float* row = level + static_cast<size_t>(i) * width;
        std::vector<std::vector<Run>> following;
        std::vector<bool> extended(open.size());
        bool inside = false;
        double begin = 0.0;
        for (int j = 0; j + 1 < width; ++j) {
            if ((row[j] > 0) == (row[j + 1] > 0)) continue;
            const double crossing = j + static_cast<double>(row[j] / (row[j] - row[j + 1]));
            inside = !inside;
            if (inside) {
                begin = crossing;
                continue;
            }
            const Run run = {static_cast<double>(i), begin, crossing};
            size_t match = 0;
            while (match < open.size()
                   && (extended[match] || !(open[match].back().begin < run.end && run.begin < open[match].back().end))) {
                ++match;
            }
            if (match == open.size()) {
                following.push_back({run});
            } else {
                extended[match] = true;
                following.push_back(open[match]);
                following.back().push_back(run);
            }
        }
        if (following.empty()) continue;
        for (size_t c = 0; c < open.size(); ++c) {
            if (!extended[c]) close(open[c]);
        }
        open = std::move(following);
    }
    for (auto& chain : open) close(chain);
    return closed;
}

std::vector<double> centre_line(const double* edges, int count, const CentreRules& rules) {
    std::vector<double> widths, finite;
    for (int k = 0; k < count; ++k) {
        const double* edge = edges + 4 * k;
        widths.push_back(std::sqrt((edge[2] - edge[0]) * (edge[2] - edge[0]) + (edge[3] - edge[1]) * (edge[3] - edge[1])));
        if (std::isfinite(widths.back())) finite.push_back(widths.back());
    }
    std::vector<double> points;
    if (finite.empty()) return points;
    const double typical_m = median(finite);
    std::vector<double> ranges;
    for (int k = 0; k < count; ++k) {
        // Cuts of another width are through slanted ends; not-a-number is no width.
        const bool is_whole = widths[k] > rules.cap_width_ratio * typical_m && widths[k] < typical_m / rules.cap_width_ratio;
        if (!is_whole) continue;
        const double* edge = edges + 4 * k;
        const double x = (edge[0] + edge[2]) / 2, y = (edge[1] + edge[3]) / 2;
        const double ahead = x - rules.foot[0], beside = y - rules.foot[1];
        const double range_m = std::sqrt(ahead * ahead + beside * beside);
        if (!(range_m <= rules.most_range_m)) continue;
        points.insert(points.end(), {x, y});
        ranges.push_back(range_m);
    }
    const size_t left = ranges.size();
    if (left < static_cast<size_t>(rules.least_points)) return {};
    if (ranges.front() > ranges.back()) {
        for (size_t k = 0; k < left / 2; ++k) {
            std::swap(points[2 * k], points[2 * (left - 1 - k)]);
            std::swap(points[2 * k + 1], points[2 * (left - 1 - k) + 1]);
        }
    }
    std::vector<double> means;
    double along_m = 0.0, bin = -1.0;
    size_t number = 0;
    for (size_t k = 0; k < left; ++k) {
        const double x = points[2 * k], y = points[2 * k + 1];
        if (k > 0) {
            const double ahead = x - points[2 * k - 2], beside = y - points[2 * k - 1];
            along_m += std::sqrt(ahead * ahead + beside * beside);
        }
        const double next_bin = std::floor(along_m / rules.step_m);
        if (next_bin != bin) {
            means.insert(means.end(), {0.0, 0.0});
            number = 0;
            bin = next_bin;
        }
        // The mean of the bin so far.
        ++number;
        double* mean = means.data() + means.size() - 2;
        mean[0] += (x - mean[0]) / static_cast<double>(number);
        mean[1] += (y - mean[1]) / static_cast<double>(number);
    }
    return means;
}

double forward_backward(double* evidence, const double* move, const double* stationary, int rows, int states) {
    std::vector<double> forward(static_cast<size_t>(rows) * states), scale(static_cast<size_t>(rows));
    std::vector<double> state(stationary, stationary + states), next(static_cast<size_t>(states));
    const auto square = static_cast<size_t>(states) * states;
    double total = 0.0;
    for (int t = 0; t < rows; ++t) {
        if (t > 0) {
            const double* step = move + square * (t - 1);
            std::fill(next.begin(), next.end(), 0.0);
            for (int from = 0; from < states; ++from) {
                for (int to = 0; to < states; ++to) next[to] += state[from] * step[from * states + to];
            }
            state.swap(next);
        }
        for (int s = 0; s < states; ++s) {
            state[s] *= evidence[t * states + s];
            scale[t] += state[s];
        }
        for (int s = 0; s < states; ++s) forward[static_cast<size_t>(t) * states + s] = state[s] /= scale[t];
        total += std::log(scale[t]);
    }
    std::vector<double> after(static_cast<size_t>(states), 1.0);
    for (int t = rows - 2; t >= 0; --t) {
        const double* step = move + square * t;
        for (int s = 0; s < states; ++s) after[s] *= evidence[(t + 1) * states + s];
        for (int from = 0; from < states; ++from) {
            next[from] = 0.0;
            for (int to = 0; to < states; ++to) next[from] += step[from * states + to] * after[to];
            next[from] /= scale[t + 1];
        }
        after.swap(next);
        for (int s = 0; s < states; ++s) forward[static_cast<size_t>(t) * states + s] *= after[s];
    }
    std::copy(forward.begin(), forward.end(), evidence);
    return total;
}

}  // namespace v2hdm
