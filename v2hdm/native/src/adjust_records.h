// The records of v2hdm.adjust.kernels, as the passes read them; arrays stay alive as long as these.
#pragma once

#include "adjust.h"
#include "adjust_layout.h"
#include "arrays.h"

namespace v2hdm::adjust {

template <typename Value, int DIMENSIONS>
using In = Array<const Value, DIMENSIONS>;

inline void require(bool holds, const char* name) {
    if (!holds) throw std::invalid_argument(std::string(name) + ": of another shape");
}

inline Index size_of(size_t size) { return static_cast<Index>(size); }

struct LayoutRecord {
    In<int32_t, 1> pair, touched;
    In<double, 2> measured, root, control, control_root;
    In<Index, 1> frame, begin, unit, joint_at, chunk, touched_at, length_at, length_first, length_second;
    In<double, 1> length_m, length_root;
    In<bool, 1> is_kept;
    Layout view;

    explicit LayoutRecord(nb::handle record)
        : pair(member<const int32_t, 1>(record, "pair", {})),
          touched(member<const int32_t, 1>(record, "touched", {})),
          measured(member<const double, 2>(record, "measured", {2, pair.size()})),
          root(member<const double, 2>(record, "root", {3, pair.size()})),
          control(member<const double, 2>(record, "control", {})),
          control_root(member<const double, 2>(record, "control_root", {control.shape(0), 3})),
          frame(member<const Index, 1>(record, "frame", {})),
          begin(member<const Index, 1>(record, "begin", {control.shape(0) + 1})),
          unit(member<const Index, 1>(record, "unit", {})),
          joint_at(member<const Index, 1>(record, "joint_at", {unit.size() - 1})),
          chunk(member<const Index, 1>(record, "chunk", {})),
          touched_at(member<const Index, 1>(record, "touched_at", {chunk.size()})),
          length_at(member<const Index, 1>(record, "length_at", {unit.size()})),
          length_first(member<const Index, 1>(record, "length_first", {})),
          length_second(member<const Index, 1>(record, "length_second", {length_first.size()})),
          length_m(member<const double, 1>(record, "length_m", {length_first.size()})),
          length_root(member<const double, 1>(record, "length_root", {length_first.size()})),
          is_kept(member<const bool, 1>(record, "is_kept", {unit.size() - 1})) {
        require(unit.size() > 0 && chunk.size() > 0, "layout");
        view = {
            size_of(pair.size()), size_of(control.shape(0)), size_of(unit.size()) - 1, size_of(chunk.size()) - 1,
            nb::cast<Index>(record.attr("moments")), nb::cast<Index>(record.attr("most_seen")),
            nb::cast<Index>(record.attr("most_joined")), pair.data(), measured.data(), root.data(), frame.data(), begin.data(), unit.data(), joint_at.data(), chunk.data(),
            touched.data(), touched_at.data(), control.data(), control_root.data(), length_at.data(),
            length_first.data(), length_second.data(), length_m.data(), length_root.data(), is_kept.data(),
        };
    }
};

struct BaseRecord {
    In<double, 2> table, corners;
    Array<double, 2> lower, rows;
    Array<double, 1> joint;
    Base view;

    explicit BaseRecord(nb::handle record)
        : table(member<const double, 2>(record, "table", {})), corners(member<const double, 2>(record, "corners", {})),
          lower(member<double, 2>(record, "lower", {3})), rows(member<double, 2>(record, "rows", {})),
          joint(member<double, 1>(record, "joint", {})) {
        require(table.shape(1) == 16 && corners.shape(1) == 2, "base");
        view = {
            table.data(), corners.data(), size_of(table.shape(0)), size_of(lower.shape(1)), size_of(rows.shape(1)),
            nb::cast<int>(record.attr("code")), nb::cast<double>(record.attr("scale")), lower.data(), joint.data(),
            rows.data(), rows.shape(0) > 0,
        };
    }
};

struct ScratchRecord {
    Array<int32_t, 1> slot;
    Array<double, 2> coupling, observed, block, rows;
    Array<double, 1> step, gradient;
    Scratch view;

    explicit ScratchRecord(nb::handle record)
        : slot(member<int32_t, 1>(record, "slot", {})), coupling(member<double, 2>(record, "coupling", {})),
          observed(member<double, 2>(record, "observed", {})), block(member<double, 2>(record, "block", {})),
          rows(member<double, 2>(record, "rows", {block.shape(0)})),
          step(member<double, 1>(record, "step", {block.shape(0)})),
          gradient(member<double, 1>(record, "gradient", {block.shape(0)})) {
        require(coupling.shape(1) == 12 && observed.shape(1) == 8 && block.shape(1) == block.shape(0), "scratch");
        view = {
            slot.data(), coupling.data(), observed.data(), block.data(), step.data(), gradient.data(), rows.data(),
            size_of(block.shape(1)), size_of(rows.shape(1)),
        };
    }
};

struct LinearisationRecord {
    Array<double, 2> costs, wrench, coupled, carried, squares;
    Array<double, 1> whitened, failed;
    Array<double, 3> tip;
    Linearisation view;

    explicit LinearisationRecord(nb::handle record)
        : costs(member<double, 2>(record, "costs", {})), wrench(member<double, 2>(record, "wrench", {})),
          coupled(member<double, 2>(record, "coupled", {})), carried(member<double, 2>(record, "carried", {costs.shape(0)})),
          squares(member<double, 2>(record, "squares", {})), whitened(member<double, 1>(record, "whitened", {})),
          failed(member<double, 1>(record, "failed", {costs.shape(0)})),
          tip(member<double, 3>(record, "tip", {costs.shape(0), carried.shape(1), carried.shape(1)})) {
        require(costs.shape(1) == 3 && wrench.shape(1) == 6 && squares.shape(1) == 21, "linearisation");
        view = {
            costs.data(), wrench.data(), coupled.data(), carried.data(), whitened.data(), squares.data(), tip.data(),
            failed.data(), size_of(tip.shape(1)),
        };
    }
};

struct EvaluationRecord {
    Array<double, 2> costs, wrench, coupled, carried, corners;
    Array<double, 1> whitened;
    Evaluation view;

    explicit EvaluationRecord(nb::handle record)
        : costs(member<double, 2>(record, "costs", {})), wrench(member<double, 2>(record, "wrench", {})),
          coupled(member<double, 2>(record, "coupled", {})), carried(member<double, 2>(record, "carried", {costs.shape(0)})),
          corners(member<double, 2>(record, "corners", {})),
          whitened(member<double, 1>(record, "whitened", {corners.size()})) {
        require(costs.shape(1) == 3 && wrench.shape(1) == 6, "evaluation");
        view = {
            costs.data(), wrench.data(), coupled.data(), carried.data(), corners.data(), whitened.data(),
            size_of(carried.shape(1)),
        };
    }
};

struct TileMapRecord {
    In<Index, 1> position, begin, row, at;
    TileMap view;

    explicit TileMapRecord(nb::handle record)
        : position(member<const Index, 1>(record, "position", {})),
          begin(member<const Index, 1>(record, "begin", {position.size()})),
          row(member<const Index, 1>(record, "row", {})), at(member<const Index, 1>(record, "at", {row.size()})) {
        view = {
            nb::cast<Index>(record.attr("per_tile")), nb::cast<Index>(record.attr("size")), size_of(position.size()),
            position.data(), begin.data(), row.data(), at.data(),
        };
    }
};

struct FactorRecord {
    In<double, 1> values;
    In<Index, 1> at, rows, begin;
    In<double, 2> tip;
    Factor view;

    explicit FactorRecord(nb::handle record)
        : values(member<const double, 1>(record, "values", {})), at(member<const Index, 1>(record, "at", {})),
          rows(member<const Index, 1>(record, "rows", {})), begin(member<const Index, 1>(record, "begin", {at.size() + 1})),
          tip(member<const double, 2>(record, "tip", {})) {
        view = {
            values.data(), at.data(), rows.data(), begin.data(), size_of(at.size()),
            nb::cast<Index>(record.attr("size")), size_of(tip.shape(0)), tip.data(),
        };
    }
};

struct ColumnsRecord {
    In<Index, 1> camera, frame, corner;
    In<double, 2> pinhole_px, intrinsic;
    In<double, 3> covariance_px;
    Columns view;

    explicit ColumnsRecord(nb::handle record)
        : camera(member<const Index, 1>(record, "camera", {})),
          frame(member<const Index, 1>(record, "frame", {camera.size()})),
          corner(member<const Index, 1>(record, "corner", {camera.size()})),
          pinhole_px(member<const double, 2>(record, "pinhole_px", {camera.size(), 2})),
          intrinsic(member<const double, 2>(record, "intrinsic", {})),
          covariance_px(member<const double, 3>(record, "covariance_px", {camera.size(), 2, 2})) {
        require(intrinsic.shape(1) == 4, "intrinsic");
        view = {
            camera.data(), frame.data(), corner.data(), pinhole_px.data(), covariance_px.data(), intrinsic.data(),
            size_of(camera.size()),
        };
    }
};

}  // namespace v2hdm::adjust
