// What Python calls to find pieces of paint.
#include "arrays.h"
#include "modules.h"
#include "pieces.h"

namespace v2hdm {
namespace {

using namespace nb::literals;

// Rectangles (n, 4) around components: left, top, width, height.
nb::object boxes_of(const std::vector<Component>& components) {
    const Made<int64_t> made({components.size(), 4});
    int64_t* box = made.data;
    for (const Component& component : components) {
        *box++ = component.left;
        *box++ = component.top;
        *box++ = component.right - component.left;
        *box++ = component.bottom - component.top;
    }
    return made.array;
}

nb::object numbers_of(const std::vector<int32_t>& numbers) {
    const Made<int64_t> made({numbers.size()});
    std::copy(numbers.begin(), numbers.end(), made.data);
    return made.array;
}

nb::object cells_of(const std::vector<Component>& components) {
    const Made<int64_t> made({components.size()});
    int64_t* cells = made.data;
    for (const Component& component : components) *cells++ = component.elements;
    return made.array;
}

nb::tuple find(nb::handle level_object, double least_row, float sure, float doubtful, int least_cells) {
    const auto level = array_of<const float, 2>(level_object, "level");
    const size_t height = level.shape(0), width = level.shape(1);
    if (height < 2 || width < 2) throw std::invalid_argument("level: has no frame");
    const Made<int16_t> piece({height, width}), area({height, width});
    Pieces pieces;
    {
        const nb::gil_scoped_release unlocked;
        const PaintRules rules = {sure, doubtful, least_cells};
        pieces = find_pieces(
            level.data(), static_cast<int>(height), static_cast<int>(width), least_row, rules, piece.data, area.data);
    }
    return nb::make_tuple(
        piece.array, boxes_of(pieces.pieces), numbers_of(pieces.sure_parts), area.array, boxes_of(pieces.areas),
        cells_of(pieces.areas), numbers_of(pieces.area));
}

// The level in the box around each piece, positive in it only.
nb::list signed_levels(nb::handle level_object, nb::handle piece_object, nb::handle box_object) {
    const auto level = array_of<const float, 2>(level_object, "level");
    const auto piece = array_of<const int16_t, 2>(piece_object, "piece");
    const auto boxes = array_of<const int64_t, 2>(box_object, "boxes");
    const int height = static_cast<int>(level.shape(0)), width = static_cast<int>(level.shape(1));
    if (piece.shape(0) != level.shape(0) || piece.shape(1) != level.shape(1) || boxes.shape(1) != 4) {
        throw std::invalid_argument("level, piece and boxes: of different shapes");
    }
    const PieceMap map = {piece.data(), level.data(), height, width};
    nb::list listed;
    for (size_t k = 0; k < boxes.shape(0); ++k) {
        const int64_t* box = boxes.data() + 4 * k;
        const bool is_inside = box[0] > 0 && box[1] > 0 && box[2] > 0 && box[3] > 0 && box[0] + box[2] < width
            && box[1] + box[3] < height;
        if (!is_inside) throw std::invalid_argument("boxes: beyond the map");
        const Box framed = {
            static_cast<int>(box[1]) - 1, static_cast<int>(box[0]) - 1, static_cast<int>(box[1] + box[3]) + 1,
            static_cast<int>(box[0] + box[2]) + 1,
        };
        const Made<float> made({static_cast<size_t>(box[3]) + 2, static_cast<size_t>(box[2]) + 2});
        sign(map, static_cast<int>(k) + 1, framed, made.data);
        listed.append(made.array);
    }
    return listed;
}

}  // namespace

void add_pieces(nb::module_& module) {
    module.def("find_pieces", &find, "level"_a, "least_row"_a, "sure"_a, "doubtful"_a, "least_cells"_a);
    module.def("signed_levels", &signed_levels, "level"_a, "piece"_a, "boxes"_a);
}

}  // namespace v2hdm
