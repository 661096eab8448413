// What Python calls of the lattice.
#include <algorithm>
#include <vector>

#include "arrays.h"
#include "lattice.h"
#include "modules.h"
#include "source_arrays.h"

namespace v2hdm {
namespace {

using namespace nb::literals;

// Arrays of M markings, a lattice.Placed.
struct MarkingArrays {
    size_t count;
    Array<const int64_t, 2> pieces;
    Array<const double, 2> middle;
    Array<const double, 3> scale;
    Array<const float, 3> outward, axes;

    explicit MarkingArrays(nb::handle object)
        : count(array_of<const int64_t, 2>(object.attr("pieces"), "pieces").shape(0)),
          pieces(member<const int64_t, 2>(object, "pieces", {count, 2})),
          middle(member<const double, 2>(object, "middle", {count, 2})),
          scale(member<const double, 3>(object, "scale", {count, 2, 2})),
          outward(member<const float, 3>(object, "outward", {count, 4, 3})),
          axes(member<const float, 3>(object, "axes", {count, 2, 3})) {}

    Marking of(size_t m) const {
        return {
            pieces.data()[2 * m], pieces.data()[2 * m + 1], middle.data() + 2 * m, scale.data() + 4 * m,
            outward.data() + 12 * m, axes.data() + 6 * m,
        };
    }
};

// The arrays of a lattice.Lattice of M markings with rows of N pixels.
struct LatticeArrays {
    Made<float> points, values, use, of_side, hats, across;
    Made<bool> limited;
    Made<double> clipped;
    Made<int64_t> neighbours, count;
    size_t row, axes;

    LatticeArrays(size_t markings, size_t row, size_t axes)
        : points({markings, 3, row}), values({markings, row}), use({markings, row}), of_side({markings, 4, row}),
          hats({markings, HATS, row}), across({markings, row}), limited({markings, row}), clipped({markings, 1}),
          neighbours({markings, axes, row}), count({markings, 1}), row(row), axes(axes) {}

    LatticeRows of(size_t m) const {
        return {
            static_cast<int>(row), points.data + 3 * m * row, values.data + m * row, use.data + m * row,
            of_side.data + 4 * m * row, hats.data + HATS * m * row, across.data + m * row, limited.data + m * row,
            clipped.data + m,
        };
    }

    nb::dict fields() const {
        nb::dict named;
        named["points"] = points.array;
        named["values"] = values.array;
        named["use"] = use.array;
        named["limited"] = limited.array;
        named["clipped"] = clipped.array;
        named["neighbours"] = neighbours.array;
        named["of_side"] = of_side.array;
        named["hats"] = hats.array;
        named["across"] = across.array;
        named["count"] = count.array;
        return named;
    }
};

nb::dict look_at(nb::handle source_object, nb::handle placed, nb::handle columns, nb::handle rows, double grey_first) {
    const SourceArrays source(source_object);
    const MarkingArrays markings(placed);
    const auto u = array_of<const int64_t, 2>(columns, "columns");
    const auto v = array_of<const int64_t, 2>(rows, "rows");
    const size_t row = u.shape(1);
    if (u.shape(0) != markings.count || v.shape(0) != markings.count || v.shape(1) != row) {
        throw std::invalid_argument("columns and rows: of another shape");
    }
    const LatticeArrays lattice(markings.count, row, 0);
    {
        const nb::gil_scoped_release unlocked;
        for (size_t m = 0; m < markings.count; ++m) {
            LatticeRows into = lattice.of(m);
            lattice.count.data[m] = static_cast<int64_t>(row);
            look(source.source, markings.of(m), static_cast<int>(row), u.data() + m * row, v.data() + m * row,
                 grey_first, into);
        }
    }
    return lattice.fields();
}

std::vector<Chosen> chosen_of(nb::handle object, size_t count) {
    const auto columns = array_of<const int64_t, 2>(object.attr("columns"), "columns");
    const auto rows = array_of<const int64_t, 2>(object.attr("rows"), "rows");
    const size_t across = columns.shape(1), down = rows.shape(1);
    const auto size = member<const int64_t, 2>(object, "size", {count, 2});
    const auto right = member<const bool, 2>(object, "near_right", {count, across});
    const auto below = member<const bool, 2>(object, "near_below", {count, down});
    const auto outward = member<const float, 3>(object, "outward", {count, 4, 3});
    const auto spare = member<const float, 1>(object, "spare_px", {count});
    if (columns.shape(0) != count || rows.shape(0) != count) throw std::invalid_argument("columns: of another shape");
    const float outside_px = nb::cast<float>(object.attr("outside_px"));
    const float inside_px = nb::cast<float>(object.attr("inside_px"));
    const int most = nb::cast<int>(object.attr("most"));
    std::vector<Chosen> chosen;
    const nb::gil_scoped_release unlocked;
    for (size_t m = 0; m < count; ++m) {
        const int64_t *column = columns.data() + m * across, *row = rows.data() + m * down;
        const auto width = std::count_if(column, column + across, [&](int64_t c) { return c < size.data()[2 * m]; });
        const auto height = std::count_if(row, row + down, [&](int64_t r) { return r < size.data()[2 * m + 1]; });
        const float bow_px = spare.data()[m];
        const Band band = {
            static_cast<int>(width), static_cast<int>(height), column, row, right.data() + m * across,
            below.data() + m * down, outward.data() + 12 * m, bow_px + outside_px, bow_px + inside_px, most,
        };
        chosen.push_back(choose(band));
    }
    return chosen;
}

nb::dict lay_lattice(nb::handle source_object, nb::handle placed, nb::handle band, double grey_first) {
    const SourceArrays source(source_object);
    const MarkingArrays markings(placed);
    auto chosen = chosen_of(band, markings.count);
    const auto low = member<const int64_t, 2>(band, "low", {markings.count, 2});
    size_t row = 1;
    for (const Chosen& pixels : chosen) row = std::max(row, pixels.column.size());
    const LatticeArrays lattice(markings.count, row, 2);
    {
        const nb::gil_scoped_release unlocked;
        for (size_t m = 0; m < markings.count; ++m) {
            Chosen& pixels = chosen[m];
            for (auto& u : pixels.column) u += low.data()[2 * m];
            for (auto& v : pixels.row) v += low.data()[2 * m + 1];
            std::copy(pixels.right.begin(), pixels.right.end(), lattice.neighbours.data + 2 * m * row);
            std::copy(pixels.below.begin(), pixels.below.end(), lattice.neighbours.data + (2 * m + 1) * row);
            lattice.count.data[m] = static_cast<int64_t>(pixels.column.size());
            LatticeRows into = lattice.of(m);
            look(source.source, markings.of(m), static_cast<int>(pixels.column.size()), pixels.column.data(),
                 pixels.row.data(), grey_first, into);
        }
    }
    return lattice.fields();
}

}  // namespace

void add_lattice(nb::module_& module) {
    module.def("look", &look_at, "source"_a, "placed"_a, "columns"_a, "rows"_a, "grey_first"_a);
    module.def("lay_lattice", &lay_lattice, "source"_a, "placed"_a, "band"_a, "grey_first"_a);
}

}  // namespace v2hdm
