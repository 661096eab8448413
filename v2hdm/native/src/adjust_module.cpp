// What Python calls of the adjustment: each function takes what its twin in v2hdm.adjust.kernels takes. Workspaces
// that only the twin needs have no name.
#include "adjust.h"
#include "adjust_layout.h"
#include "adjust_records.h"
#include "adjust_tables.h"
#include "modules.h"

#include <algorithm>

namespace v2hdm {
namespace {

using namespace adjust;

// Without Python's lock, so that threads run side by side.
template <typename Work>
void unlocked(Work&& work) {
    const nb::gil_scoped_release release;
    work();
}

void check_range(Index begin, Index end, const Layout& layout) {
    require(0 <= begin && begin <= end && end <= layout.chunks, "chunks");
}

void linearise_chunks(
    Index begin, Index end, nb::handle layout_object, nb::handle base_object, nb::handle clock_object, bool by_pair,
    nb::handle scratch_object, nb::handle out_object) {
    const LayoutRecord layout(layout_object);
    const BaseRecord base(base_object);
    const auto clock = array_of<const double, 2>(clock_object, "clock");
    const ScratchRecord scratch(scratch_object);
    const LinearisationRecord out(out_object);
    check_range(begin, end, layout.view);
    unlocked([&] {
        passes().linearise(begin, end, layout.view, base.view, clock.data(), by_pair, scratch.view, out.view);
    });
}

void subtract_columns(
    Index begin, Index end, nb::handle layout_object, nb::handle base_object, nb::handle tiles_object,
    nb::handle state_object, nb::handle clock_object, Index unknowns, nb::handle marks_object,
    nb::handle scratch_object, nb::handle values_object) {
    const LayoutRecord layout(layout_object);
    const BaseRecord base(base_object);
    const TileMapRecord tiles(tiles_object);
    const auto by_state = array_of<const double, 2>(state_object, "by_state");
    const auto clock = array_of<const double, 2>(clock_object, "clock");
    const auto marks = array_of<Index, 2>(marks_object, "marks");
    const ScratchRecord scratch(scratch_object);
    const auto values = array_of<double, 1>(values_object, "values");
    require(marks.shape(0) == 5 && size_of(marks.shape(1)) == tiles.view.tiles + 1, "marks");
    const FrameJacobians by = {by_state.data(), clock.data(), size_of(by_state.shape(1)) / 6, unknowns};
    unlocked([&] {
        passes().subtract_frames(
            begin, end, layout.view, base.view, tiles.view, by, marks.data(), scratch.view, values.data());
    });
}

void evaluate_chunks(
    Index begin, Index end, nb::handle layout_object, nb::handle base_object, nb::handle table_object,
    nb::handle motion_object, nb::handle cameras_object, nb::handle whitened_object, nb::handle scratch_object,
    nb::handle out_object) {
    const LayoutRecord layout(layout_object);
    const BaseRecord base(base_object);
    const auto table = array_of<const double, 2>(table_object, "table");
    const auto motion = array_of<const double, 2>(motion_object, "motion");
    const auto cameras = array_of<const double, 1>(cameras_object, "cameras");
    const auto whitened = array_of<const double, 1>(whitened_object, "whitened");
    const ScratchRecord scratch(scratch_object);
    const EvaluationRecord out(out_object);
    check_range(begin, end, layout.view);
    require(whitened.size() == out.whitened.size(), "whitened");
    const Step step = {table.data(), motion.data(), cameras.data(), whitened.data()};
    unlocked([&] { passes().evaluate(begin, end, layout.view, base.view, step, scratch.view, out.view); });
}

void carry_chunks(
    Index begin, Index end, nb::handle layout_object, nb::handle base_object, nb::handle corner_object,
    nb::handle scratch_object, nb::handle out_object) {
    const LayoutRecord layout(layout_object);
    const BaseRecord base(base_object);
    const auto by_corner = array_of<const double, 2>(corner_object, "by_corner");
    const ScratchRecord scratch(scratch_object);
    const EvaluationRecord out(out_object);
    check_range(begin, end, layout.view);
    unlocked([&] { passes().carry(begin, end, layout.view, base.view, by_corner.data(), scratch.view, out.view); });
}

void meet_ground_chunks(
    Index begin, Index end, nb::handle layout_object, nb::handle homographies_object, nb::handle corners_object,
    nb::handle determined_object) {
    const LayoutRecord layout(layout_object);
    const auto homographies = array_of<const double, 2>(homographies_object, "homographies");
    const auto corners = array_of<double, 2>(corners_object, "corners");
    const auto determined = array_of<bool, 1>(determined_object, "determined");
    check_range(begin, end, layout.view);
    unlocked([&] {
        passes().meet_ground(begin, end, layout.view, homographies.data(), corners.data(), determined.data());
    });
}

void report_chunks(
    Index begin, Index end, nb::handle layout_object, nb::handle table_object, nb::handle corners_object,
    nb::handle order_object, nb::handle focal_object, nb::handle out_object) {
    const LayoutRecord layout(layout_object);
    const auto table = array_of<const double, 2>(table_object, "table");
    const auto corners = array_of<const double, 2>(corners_object, "corners");
    const auto order = array_of<const int32_t, 1>(order_object, "order");
    const auto focal = array_of<const double, 2>(focal_object, "focal");
    const size_t count = layout.pair.size();
    const auto residual = member<double, 2>(out_object, "residual_px", {count, 2});
    const auto squared = member<double, 1>(out_object, "mahalanobis2", {count});
    const auto behind = member<bool, 1>(out_object, "behind", {count});
    check_range(begin, end, layout.view);
    const Report out = {residual.data(), squared.data(), behind.data()};
    unlocked([&] {
        passes().report(begin, end, layout.view, table.data(), corners.data(), order.data(), focal.data(), out);
    });
}

void residuals_of_chunks(
    Index begin, Index end, nb::handle layout_object, nb::handle table_object, nb::handle corners_object,
    nb::handle out_object) {
    const LayoutRecord layout(layout_object);
    const auto table = array_of<const double, 2>(table_object, "table");
    const auto corners = array_of<const double, 2>(corners_object, "corners");
    const auto out = array_of<double, 2>(out_object, "out");
    check_range(begin, end, layout.view);
    require(out.shape(1) == layout.pair.size(), "out");
    unlocked([&] { passes().residuals(begin, end, layout.view, table.data(), corners.data(), out.data()); });
}

void pull_all(
    nb::handle layout_object, nb::handle table_object, nb::handle corners_object, nb::handle residual_object,
    nb::handle, nb::handle wrench_object, nb::handle by_corner_object) {
    const LayoutRecord layout(layout_object);
    const auto table = array_of<const double, 2>(table_object, "table");
    const auto corners = array_of<const double, 2>(corners_object, "corners");
    const auto by_residual = array_of<const double, 2>(residual_object, "by_residual");
    const auto wrench = array_of<double, 2>(wrench_object, "wrench");
    const auto by_corner = array_of<double, 2>(by_corner_object, "by_corner");
    require(by_residual.shape(1) == layout.pair.size(), "by_residual");
    unlocked([&] {
        passes().pull(layout.view, table.data(), corners.data(), by_residual.data(), wrench.data(), by_corner.data());
    });
}

void couplings_of(nb::handle layout_object, nb::handle base_object, nb::handle corner_object, nb::handle,
    nb::handle out_object) {
    const LayoutRecord layout(layout_object);
    const BaseRecord base(base_object);
    const auto corner = array_of<const Index, 1>(corner_object, "corner");
    const auto out = array_of<double, 2>(out_object, "out");
    require(corner.size() == layout.pair.size() && out.shape(0) == corner.size() && out.shape(1) == 12, "out");
    passes().couplings(layout.view, base.view, corner.data(), size_of(corner.size()), out.data());
}

template <void (*Passes::*SUBSTITUTE)(const Factor&, double*)>
void substitute(nb::handle factor_object, nb::handle out_object) {
    const FactorRecord factor(factor_object);
    const auto out = array_of<double, 1>(out_object, "out");
    const Index rows = factor.view.columns * factor.view.size + factor.view.tip_size;
    require(size_of(out.size()) == rows, "out");
    (passes().*SUBSTITUTE)(factor.view, out.data());
}

void gather_parts(nb::handle touched_object, nb::handle parts_object, nb::handle out_object) {
    const auto touched = array_of<const int32_t, 1>(touched_object, "touched");
    const auto parts = array_of<const double, 2>(parts_object, "parts");
    const auto out = array_of<double, 2>(out_object, "out");
    require(parts.shape(0) == touched.size() && out.shape(1) == parts.shape(1), "parts");
    gather(touched.data(), size_of(touched.size()), parts.data(), size_of(parts.shape(1)), out.data());
}

void compose_pairs(nb::handle cameras_object, nb::handle vehicle_object, nb::handle out_object) {
    const auto cameras = array_of<const double, 4>(cameras_object, "cameras");
    const auto vehicle = array_of<const double, 3>(vehicle_object, "vehicle_from_map");
    const auto out = array_of<double, 4>(out_object, "out");
    require(out.size() == cameras.shape(0) * vehicle.size(), "out");
    compose(
        cameras.data(), cameras.shape(1) > 1, vehicle.data(), size_of(cameras.shape(0)), size_of(vehicle.shape(0)),
        out.data());
}

void move_cameras(
    nb::handle tangents_object, nb::handle transforms_object, nb::handle exp_object, nb::handle left_jacobian_object,
    nb::handle, nb::handle moved_object, nb::handle jacobian_object) {
    const auto tangents = array_of<const double, 2>(tangents_object, "tangents");
    const auto transforms = array_of<const double, 3>(transforms_object, "dst_from_src");
    const auto exp = array_of<const double, 2>(exp_object, "exp_series");
    const auto left_jacobian = array_of<const double, 2>(left_jacobian_object, "jacobian_series");
    const auto moved = array_of<double, 3>(moved_object, "moved");
    const auto jacobian = array_of<double, 3>(jacobian_object, "jacobian");
    const size_t count = tangents.shape(0);
    require(transforms.size() == 16 * count && moved.size() == 16 * count && jacobian.size() == 36 * count, "moved");
    move(
        tangents.data(), transforms.data(), size_of(count),
        {exp.data(), size_of(exp.shape(0)), size_of(exp.shape(1))},
        {left_jacobian.data(), size_of(left_jacobian.shape(0)), size_of(left_jacobian.shape(1))}, moved.data(),
        jacobian.data());
}

Index first_unsound_of(
    nb::handle columns_object, Index frames, double symmetric_to, double max_slope, nb::handle corner_object,
    nb::handle camera_object) {
    const ColumnsRecord columns(columns_object);
    const auto by_corner = array_of<Index, 1>(corner_object, "by_corner");
    const auto by_camera = array_of<Index, 1>(camera_object, "by_camera");
    require(by_camera.size() == columns.intrinsic.shape(0), "by_camera");
    const Tally tally = {by_corner.data(), by_camera.data(), size_of(by_corner.size()), size_of(by_camera.size())};
    return first_unsound(columns.view, frames, symmetric_to, max_slope, tally);
}

Index arrange_columns(
    nb::handle columns_object, nb::handle rank_object, Index frames, nb::handle corner_at_object,
    nb::handle order_object, nb::handle corner_object, nb::handle pair_object) {
    const ColumnsRecord columns(columns_object);
    const auto rank = array_of<const Index, 1>(rank_object, "rank");
    const auto corner_at = array_of<Index, 1>(corner_at_object, "corner_at");
    const auto order = array_of<int32_t, 1>(order_object, "order");
    const auto corner = array_of<int32_t, 1>(corner_object, "corner");
    const auto pair = array_of<int32_t, 1>(pair_object, "pair");
    const size_t count = columns.camera.size();
    require(order.size() == count && corner.size() == count && pair.size() == count, "order");
    require(corner_at.size() == rank.size() + 1, "corner_at");
    return arrange(
        columns.view, rank.data(), frames,
        {corner_at.data(), size_of(rank.size()), order.data(), corner.data(), pair.data()});
}

Index lay_out_columns(
    nb::handle columns_object, nb::handle order_object, nb::handle pair_object, int32_t frames, double line_excess,
    nb::handle measured_object, nb::handle root_object) {
    const ColumnsRecord columns(columns_object);
    const auto order = array_of<const int32_t, 1>(order_object, "order");
    const auto pair = array_of<const int32_t, 1>(pair_object, "pair");
    require(frames > 0 && pair.size() == order.size(), "pair");
    const auto measured = array_of<double, 2>(measured_object, "measured");
    const auto root = array_of<double, 2>(root_object, "root");
    const size_t count = order.size();
    require(count == columns.camera.size(), "order");
    require(measured.size() == 2 * count && root.size() == 3 * count, "measured");
    const Sorted sorted = {order.data(), pair.data(), frames};
    return lay_out(columns.view, sorted, line_excess, measured.data(), root.data());
}

void classify_observations(
    nb::handle corner_object, nb::handle mahalanobis2_object, nb::handle behind_object, double gate,
    nb::handle verdict_object, nb::handle sightings_object, nb::handle accepted_object) {
    const auto corner = array_of<const Index, 1>(corner_object, "corner");
    const auto mahalanobis2 = array_of<const double, 1>(mahalanobis2_object, "mahalanobis2");
    const auto behind = array_of<const bool, 1>(behind_object, "behind");
    const auto verdict = array_of<int8_t, 1>(verdict_object, "verdict");
    const auto sightings = array_of<Index, 1>(sightings_object, "sightings");
    const auto accepted = array_of<Index, 1>(accepted_object, "accepted");
    const size_t count = corner.size();
    require(mahalanobis2.size() == count && behind.size() == count && verdict.size() == count, "verdict");
    require(accepted.size() == sightings.size(), "accepted");
    const Index corners = size_of(sightings.size());
    const auto is_within = [&](Index place) { return 0 <= place && place < corners; };
    require(std::all_of(corner.data(), corner.data() + count, is_within), "corner");
    classify(
        {corner.data(), mahalanobis2.data(), behind.data(), size_of(count)}, gate,
        {verdict.data(), sightings.data(), accepted.data(), corners});
}

Index first_not_rigid_of(nb::handle transforms_object, double orthonormal_to) {
    const auto transforms = array_of<const double, 3>(transforms_object, "transforms");
    require(transforms.shape(1) == 4 && transforms.shape(2) == 4, "transforms");
    return first_not_rigid(transforms.data(), size_of(transforms.shape(0)), orthonormal_to);
}

Index find_touched_pairs(
    nb::handle pair_object, nb::handle chunk_object, nb::handle is_touched_object, nb::handle touched_object,
    nb::handle touched_at_object) {
    const auto pair = array_of<const int32_t, 1>(pair_object, "pair");
    const auto chunk = array_of<const Index, 1>(chunk_object, "chunk");
    const auto is_touched = array_of<uint8_t, 1>(is_touched_object, "is_touched");
    const auto touched = array_of<int32_t, 1>(touched_object, "touched");
    const auto touched_at = array_of<Index, 1>(touched_at_object, "touched_at");
    const Index chunks = size_of(chunk.size()) - 1;
    require(chunks >= 0 && touched_at.size() == chunk.size() && touched.size() == pair.size(), "touched");
    for (Index q = 0; q < chunks; ++q) require(0 <= chunk.data()[q] && chunk.data()[q] <= chunk.data()[q + 1], "chunk");
    require(chunk.data()[chunks] == size_of(pair.size()), "chunk");
    const Index pairs = size_of(is_touched.size());
    const auto is_within = [&](int32_t place) { return 0 <= place && place < pairs; };
    require(std::all_of(pair.data(), pair.data() + pair.size(), is_within), "pair");
    return find_touched(
        pair.data(), chunk.data(), chunks, is_touched.data(), {touched.data(), touched_at.data()});
}

}  // namespace

void add_adjust(nb::module_& module) {
    nb::module_ adjust = module.def_submodule("adjust");
    adjust.def("linearise", &linearise_chunks);
    adjust.def("subtract_frames", &subtract_columns);
    adjust.def("evaluate", &evaluate_chunks);
    adjust.def("carry", &carry_chunks);
    adjust.def("meet_ground", &meet_ground_chunks);
    adjust.def("report", &report_chunks);
    adjust.def("residuals", &residuals_of_chunks);
    adjust.def("pull", &pull_all);
    adjust.def("couplings", &couplings_of);
    adjust.def("forward", &substitute<&Passes::forward>);
    adjust.def("backward", &substitute<&Passes::backward>);
    adjust.def("gather", &gather_parts);
    adjust.def("compose", &compose_pairs);
    adjust.def("move", &move_cameras);
    adjust.def("first_unsound", &first_unsound_of);
    adjust.def("arrange", &arrange_columns);
    adjust.def("lay_out", &lay_out_columns);
    adjust.def("classify", &classify_observations);
    adjust.def("first_not_rigid", &first_not_rigid_of);
    adjust.def("find_touched", &find_touched_pairs);
    nb::dict constants;
    constants["NEAR_M"] = NEAR_M;
    constants["WEIGHT_FLOOR"] = WEIGHT_FLOOR;
    constants["CORNER_FLOOR"] = CORNER_FLOOR;
    constants["PIVOT_FLOOR"] = PIVOT_FLOOR;
    constants["MIN_DEPRESSION_SINE"] = MIN_DEPRESSION_SINE;
    adjust.attr("CONSTANTS") = constants;
    add_adjust_rig(adjust);
}

}  // namespace v2hdm
