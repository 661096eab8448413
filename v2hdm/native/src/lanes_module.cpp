// What Python calls of lines of lanes.
#include <algorithm>
#include <vector>

#include "arrays.h"
#include "lanes.h"
#include "modules.h"

namespace v2hdm {
namespace {

using namespace nb::literals;

nb::list chains_of(nb::handle columns, nb::handle rows, const nb::dict& named) {
    const auto u_px = array_of<const double, 1>(columns, "u_px");
    const auto v_px = array_of<const double, 1>(rows, "v_px");
    if (u_px.size() != v_px.size()) throw std::invalid_argument("u_px and v_px: of different lengths");
    const auto number = [&](const char* name) { return nb::cast<double>(named[name]); };
    const ChainRules rules = {
        number("max_gap_px"), number("max_slope"), number("gate_px"), number("young"), number("widening"),
        number("row_step_px"), nb::cast<int>(named["slope_points"]), nb::cast<int>(named["min_chain"]),
    };
    nb::list chains;
    for (const auto& members : find_chains(u_px.data(), v_px.data(), static_cast<int>(u_px.size()), rules)) {
        const Made<int64_t> made({members.size()});
        std::copy(members.begin(), members.end(), made.data);
        chains.append(made.array);
    }
    return chains;
}

nb::list branches_of(nb::handle object, int least) {
    const auto level = array_of<const float, 2>(object, "level");
    const auto found = branches(level.data(), static_cast<int>(level.shape(0)), static_cast<int>(level.shape(1)), least);
    nb::list listed;
    for (const auto& runs : found) {
        const Made<double> made({runs.size(), 3});
        std::copy(runs.begin(), runs.end(), reinterpret_cast<Run*>(made.data));
        listed.append(made.array);
    }
    return listed;
}

nb::list centre_lines(const nb::list& branches, nb::handle foot, double step_m, double most_range_m, double cap_width_ratio, int least_points) {
    const auto below = array_of<const double, 1>(foot, "foot");
    if (below.size() != 2) throw std::invalid_argument("foot: of another shape");
    const CentreRules rules = {{below.data()[0], below.data()[1]}, step_m, most_range_m, cap_width_ratio, least_points};
    nb::list lines;
    for (const nb::handle branch : branches) {
        const auto edges = array_of<const double, 3>(branch, "edges");
        if (edges.shape(1) != 2 || edges.shape(2) != 2) throw std::invalid_argument("edges: of another shape");
        const auto line = centre_line(edges.data(), static_cast<int>(edges.shape(0)), rules);
        const Made<double> made({line.size() / 2, 2});
        std::copy(line.begin(), line.end(), made.data);
        lines.append(made.array);
    }
    return lines;
}

// Overwrites the evidence (N, T, S) by the probabilities of the states; returns log likelihoods (N,).
nb::object states_of(nb::handle evidence_object, nb::handle move_object, nb::handle stationary_object) {
    const auto evidence = array_of<double, 3>(evidence_object, "evidence");
    const size_t lines = evidence.shape(0), rows = evidence.shape(1), states = evidence.shape(2);
    const auto move = array_of<const double, 4>(move_object, "move");
    const auto stationary = array_of<const double, 1>(stationary_object, "stationary");
    if (move.size() != lines * (rows - 1) * states * states || stationary.size() != states) {
        throw std::invalid_argument("move or stationary: of another shape");
    }
    const Made<double> total({lines});
    for (size_t n = 0; n < lines; ++n) {
        total.data[n] = forward_backward(
            evidence.data() + n * rows * states, move.data() + n * (rows - 1) * states * states, stationary.data(),
            static_cast<int>(rows), static_cast<int>(states));
    }
    return total.array;
}

}  // namespace

void add_lanes(nb::module_& module) {
    module.def("find_chains", &chains_of, "u_px"_a, "v_px"_a, "rules"_a);
    module.def("branches", &branches_of, "level"_a, "least"_a);
    module.def(
        "centre_lines", &centre_lines, "branches"_a, "foot"_a, "step_m"_a, "most_range_m"_a, "cap_width_ratio"_a,
        "least_points"_a);
    module.def("forward_backward", &states_of, "evidence"_a, "move"_a, "stationary"_a);
}

}  // namespace v2hdm
