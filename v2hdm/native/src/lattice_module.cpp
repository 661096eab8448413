// What Python calls of the lattice.
#include <algorithm>
#include <vector>

#include "arrays.h"
#include "lattice.h"
#include "modules.h"

namespace v2hdm {
namespace {

using namespace nb::literals;

// Arrays of a patch.Source, kept while they are looked into.
struct SourceArrays {
    Array<const uint8_t, 3> image;
    Array<const int16_t, 2> owner;
    Array<const float, 1> radiance, logs, grey;
    nb::object lens_object;
    Source source;

    explicit SourceArrays(nb::handle object)
        : image(array_of<const uint8_t, 3>(object.attr("image"), "image")),
          owner(array_of<const int16_t, 2>(object.attr("owner"), "owner")),
          radiance(member<const float, 1>(object, "radiance", {256})),
          logs(member<const float, 1>(object, "logs", {256})),
          grey(member<const float, 1>(object, "grey_weights", {3})),
          lens_object(object.attr("lens")) {
        if (image.shape(2) != 3 || image.size() == 0 || owner.size() == 0) {
            throw std::invalid_argument("image: of another shape");
        }
        source = {
            image.data(), static_cast<int>(image.shape(1)), static_cast<int>(image.shape(0)),
            owner.data(), static_cast<int>(owner.shape(1)), static_cast<int>(owner.shape(0)),
            nb::cast<int>(object.attr("top")), nb::cast<int>(object.attr("stride")),
            radiance.data(), logs.data(), nb::cast<int>(object.attr("clipped")),
            nb::cast<float>(object.attr("dark")), {grey.data()[0], grey.data()[1], grey.data()[2]},
            {nullptr, 0, 0, nb::cast<double>(object.attr("lens_step_px"))},
        };
        if (lens_object.is_none()) return;
        const auto lens = array_of<const double, 4>(lens_object, "lens");
        if (lens.shape(2) != 2 || lens.shape(3) != 4 || lens.size() == 0) throw std::invalid_argument("lens: of another shape");
        lens_array_ = lens;
        source.lens.values = lens_array_.data();
        source.lens.height = static_cast<int>(lens.shape(0));
        source.lens.width = static_cast<int>(lens.shape(1));
    }

  private:
    Array<const double, 4> lens_array_;
};

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
