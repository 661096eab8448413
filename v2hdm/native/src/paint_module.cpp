// What Python calls of pieces of paint.
#include <algorithm>

#include "arrays.h"
#include "modules.h"
#include "paint.h"

namespace v2hdm {
namespace {

using namespace nb::literals;

struct MapArrays {
    Array<const int16_t, 2> piece;
    Array<const float, 2> level;
    PieceMap map;

    MapArrays(nb::handle level_object, nb::handle piece_object)
        : piece(array_of<const int16_t, 2>(piece_object, "piece")), level(array_of<const float, 2>(level_object, "level")) {
        if (piece.shape(0) != level.shape(0) || piece.shape(1) != level.shape(1)) {
            throw std::invalid_argument("level and piece: of different shapes");
        }
        map = {piece.data(), level.data(), static_cast<int>(piece.shape(0)), static_cast<int>(piece.shape(1))};
    }
};

nb::list outlines_of(nb::handle level, nb::handle piece, int count) {
    const MapArrays arrays(level, piece);
    nb::list listed;
    for (const auto& points : outlines(arrays.map, count)) {
        const Made<double> made({points.size() / 2, 2});
        std::copy(points.begin(), points.end(), made.data);
        listed.append(made.array);
    }
    return listed;
}

nb::object signed_of(
    nb::handle level, nb::handle piece, int number, int first_row, int first_column, int last_row, int last_column) {
    const MapArrays arrays(level, piece);
    const Box box = {first_row, first_column, last_row, last_column};
    const bool is_inside = first_row >= 0 && first_column >= 0 && first_row <= last_row && first_column <= last_column
        && last_row <= arrays.map.height && last_column <= arrays.map.width;
    if (!is_inside) throw std::invalid_argument("box: beyond the map");
    const Made<float> made({static_cast<size_t>(last_row - first_row), static_cast<size_t>(last_column - first_column)});
    sign(arrays.map, number, box, made.data);
    return made.array;
}

nb::tuple tally_of(nb::handle level, nb::handle piece, int count, nb::handle kinds_object, double scale, int first_row, int first_column) {
    const MapArrays arrays(level, piece);
    const auto odds = array_of<const float, 3>(kinds_object, "kinds");
    if (odds.size() == 0 || !(scale > 0)) throw std::invalid_argument("kinds: of another shape");
    const size_t classes = odds.shape(0), pieces = static_cast<size_t>(count);
    const Kinds kinds = {
        odds.data(), static_cast<int>(classes), static_cast<int>(odds.shape(1)), static_cast<int>(odds.shape(2)),
        scale, first_row, first_column,
    };
    const Tally sums = tally(arrays.map, kinds, count);
    const Made<int64_t> cells({pieces}), best({pieces, classes});
    const Made<double> certainty({pieces}), probability({pieces, classes});
    std::copy(sums.cells.begin(), sums.cells.end(), cells.data);
    std::copy(sums.best.begin(), sums.best.end(), best.data);
    std::copy(sums.certainty.begin(), sums.certainty.end(), certainty.data);
    std::copy(sums.probability.begin(), sums.probability.end(), probability.data);
    return nb::make_tuple(cells.array, best.array, certainty.array, probability.array);
}

}  // namespace

void add_paint(nb::module_& module) {
    module.def("outlines", &outlines_of, "level"_a, "piece"_a, "count"_a);
    module.def(
        "signed", &signed_of, "level"_a, "piece"_a, "number"_a, "first_row"_a, "first_column"_a, "last_row"_a,
        "last_column"_a);
    module.def(
        "tally", &tally_of, "level"_a, "piece"_a, "count"_a, "kinds"_a, "scale"_a, "first_row"_a, "first_column"_a);
}

}  // namespace v2hdm
