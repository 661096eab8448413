// Lines of lanes; twins of v2hdm.detection.lanes.chains, lines and boundaries.
#pragma once

#include <cstdint>
#include <vector>

namespace v2hdm {

// The constants of chains.py, by their names there.
struct ChainRules {
    double max_gap_px, max_slope, gate_px, young, widening, row_step_px;
    int slope_points, min_chain;
};

// Chains of crossings, as their indices; see chains.find_chains.
std::vector<std::vector<int64_t>> find_chains(const double* u_px, const double* v_px, int count, const ChainRules& rules);

// One cut through a piece of paint: a row, and where paint begins and ends on it.
struct Run {
    double row, begin, end;
};

// The branches of a piece of paint, each a list of runs; see lines._branches.
std::vector<std::vector<Run>> branches(const float* level, int height, int width, int least);

// The constants of a centre line; see lines._centre and lines._resample.
struct CentreRules {
    double foot[2];  // below the camera
    double step_m, most_range_m, cap_width_ratio;
    int least_points;
};

// The centre line (x, y, x, y, ...) of cuts with edge points (count, 2, 2) on the ground; empty where too short.
std::vector<double> centre_line(const double* edges, int count, const CentreRules& rules);

// Probabilities of states in place of their evidence (rows, states), and the log likelihood; move is
// (rows - 1, states, states). See boundaries._forward_backward.
double forward_backward(double* evidence, const double* move, const double* stationary, int rows, int states);

}  // namespace v2hdm
