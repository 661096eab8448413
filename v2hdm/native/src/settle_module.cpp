// What Python calls of the steps: arrays are checked here, and work is done without Python's lock.
#include <algorithm>

#include "arrays.h"
#include "modules.h"
#include "settle.h"

namespace v2hdm {
namespace {

using namespace nb::literals;

FitRules fit_rules(const nb::dict& named) {
    const auto number = [&](const char* name) { return nb::cast<double>(named[name]); };
    FitRules rules = {
        number("least_blur_px"), number("most_blur_px"), number("blur_sigma_px"),
        number("contrast"), number("contrast_sigma"), number("most_contrast"), number("light_step"),
        number("most_step"), number("most_contrast_step"), number("settled_px"), number("insignificant"),
        number("held"), number("sigma_of_mad"), number("min_scatter"), number("shared_pixels"),
        number("cauchy"), number("max_correlation"), number("paint_sigma"), {},
    };
    const auto roughness = array_of<const double, 2>(named["roughness"], "roughness");
    if (roughness.size() != KNOTS * KNOTS) throw std::invalid_argument("roughness: of another shape");
    std::copy(roughness.data(), roughness.data() + roughness.size(), &rules.roughness[0][0]);
    return rules;
}

// Settle every marking of a state in place, and write its system; see state.State.settle.
void settle_all(
    nb::handle state,
    nb::handle system,
    nb::handle lattice,
    const nb::object& paint,
    nb::handle owen_table,
    const nb::dict& named_rules,
    int steps,
    double scatter) {
    const auto points = array_of<const float, 3>(lattice.attr("points"), "points");
    const size_t count = points.shape(0), row = points.shape(2);
    const auto rules = fit_rules(named_rules);
    const auto owen = array_of<const float, 2>(owen_table, "owen_table");
    const OwenTable table = {
        owen.data(), static_cast<int>(owen.shape(0)), static_cast<int>(owen.shape(1)),
        nb::cast<float>(named_rules["cells_per_blur"]), nb::cast<float>(named_rules["reach"]),
    };
    const size_t cells = static_cast<size_t>(table.cells_per_blur * table.reach);
    if (owen.shape(0) != cells + 1 || owen.shape(1) != 2 * cells + 1) {
        throw std::invalid_argument("owen_table: of another shape");
    }
    const auto values = member<const float, 2>(lattice, "values", {count, row});
    const auto use = member<const float, 2>(lattice, "use", {count, row});
    const auto of_side = member<const float, 3>(lattice, "of_side", {count, 4, row});
    const auto hats = member<const float, 3>(lattice, "hats", {count, KNOTS, row});
    const auto across = member<const float, 2>(lattice, "across", {count, row});
    const auto limited = member<const bool, 2>(lattice, "limited", {count, row});
    const auto pixels_of = member<const int64_t, 2>(lattice, "count", {count, 1});
    const auto neighbours = array_of<const int64_t, 3>(lattice.attr("neighbours"), "neighbours");
    const size_t axes = neighbours.shape(1);
    member<const int64_t, 3>(lattice, "neighbours", {count, axes, row});
    const float* painted = nullptr;
    if (!paint.is_none()) {
        const auto probability = array_of<const float, 2>(paint, "paint");
        if (probability.size() != count * row) throw std::invalid_argument("paint: of another shape");
        painted = probability.data();
    }
    const auto corners = member<double, 3>(state, "corners", {count, 4, 2});
    const auto blur_px = member<double, 1>(state, "blur_px", {count});
    const auto outline = member<const double, 3>(state, "outline", {count, 4, 2});
    const auto sigma_px = member<const double, 2>(state, "outline_sigma_px", {count, 8});
    const auto closure = member<const double, 3>(state, "closure", {count, 2, 8});
    const auto gap = member<const double, 2>(state, "gap", {count, 2});
    const auto contrast = member<double, 1>(state, "contrast", {count});
    const auto expected_contrast = member<double, 1>(state, "expected_contrast", {count});
    const auto light = member<double, 2>(state, "light", {count, KNOTS});
    const auto slope = member<double, 1>(state, "slope", {count});
    const double expected_blur_px = nb::cast<double>(state.attr("expected_blur_px"));
    const auto information = member<double, 3>(system, "information", {count, UNKNOWNS, UNKNOWNS});
    const auto scatters = member<double, 2>(system, "scatter", {count, 4});
    const auto inliers = member<double, 1>(system, "inliers", {count});
    const auto side_step = member<double, 2>(system, "side_step", {count, 8});
    const auto decrement = member<double, 1>(system, "decrement", {count});
    for (size_t m = 0; m < count; ++m) {
        const int64_t pixels = pixels_of.data()[m];
        if (pixels < 0 || pixels > static_cast<int64_t>(row)) throw std::invalid_argument("count: beyond the rows");
    }
    for (size_t i = 0; i < neighbours.size(); ++i) {
        const int64_t place = neighbours.data()[i];
        if (place < 0 || place >= static_cast<int64_t>(row)) throw std::invalid_argument("neighbours: beyond the rows");
    }

    const nb::gil_scoped_release unlocked;
    for (size_t m = 0; m < count; ++m) {
        const Pixels pixels = {
            static_cast<int>(pixels_of.data()[m]), static_cast<int>(row), static_cast<int>(axes),
            points.data() + 3 * m * row, values.data() + m * row, use.data() + m * row,
            of_side.data() + 4 * m * row, hats.data() + KNOTS * m * row, across.data() + m * row,
            limited.data() + m * row, neighbours.data() + axes * m * row,
            painted == nullptr ? nullptr : painted + m * row,
        };
        Unknowns unknowns = {
            corners.data() + 8 * m, blur_px.data() + m, contrast.data() + m, expected_contrast.data() + m,
            light.data() + KNOTS * m, slope.data() + m, outline.data() + 8 * m, sigma_px.data() + 8 * m,
            closure.data() + 16 * m, gap.data() + 2 * m, expected_blur_px,
        };
        Equations equations = {
            information.data() + UNKNOWNS * UNKNOWNS * m, scatters.data() + 4 * m, inliers.data() + m,
            side_step.data() + 8 * m, decrement.data() + m,
        };
        settle(pixels, table, rules, steps, scatter, unknowns, equations);
    }
}

}  // namespace

void add_settle(nb::module_& module) {
    module.def(
        "settle", &settle_all, "state"_a, "system"_a, "lattice"_a, "paint"_a.none(), "owen_table"_a, "rules"_a,
        "steps"_a, "scatter"_a);
}

}  // namespace v2hdm
