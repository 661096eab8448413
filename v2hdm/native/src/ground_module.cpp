// What Python calls of images on the ground.
#include <algorithm>

#include "arrays.h"
#include "ground.h"
#include "modules.h"

namespace v2hdm {
namespace {

using namespace nb::literals;

// Arrays of a warp.Nodes.
struct NodeArrays {
    Array<const double, 3> x_px, y_px, third;
    GroundNodes nodes;

    explicit NodeArrays(nb::handle object)
        : x_px(array_of<const double, 3>(object.attr("x_px"), "x_px")),
          y_px(member<const double, 3>(object, "y_px", {x_px.shape(0), x_px.shape(1), x_px.shape(1)})),
          third(member<const double, 3>(object, "third", {x_px.shape(0), x_px.shape(1), x_px.shape(1)})) {
        const size_t side = x_px.shape(1);
        if (side < 2 || x_px.shape(2) != side || TILE % (side - 1) != 0) {
            throw std::invalid_argument("nodes: of another shape");
        }
        nodes = {x_px.data(), y_px.data(), third.data(), x_px.shape(0), static_cast<int>(side)};
    }
};

template <typename Pixels>
GroundImage image_of(const Pixels& pixels, int channels) {
    return {pixels.data(), static_cast<int>(pixels.shape(0)), static_cast<int>(pixels.shape(1)), channels};
}

void check_sizes(const GroundImage& image, const GroundImage& mask) {
    if (image.height != mask.height || image.width != mask.width) throw std::invalid_argument("images of two sizes");
}

// Add an image (height, width, 3) to the sums (5, slots, TILE^2) of tiles, in place.
void add(
    nb::handle sums_object, nb::handle slot_object, nb::handle nodes_object, nb::handle shown_object,
    nb::handle pixels_object, nb::handle alpha_object, float fullness, float finest) {
    const auto sums = array_of<float, 3>(sums_object, "sums");
    const auto slot = array_of<const int64_t, 1>(slot_object, "slot");
    const NodeArrays arrays(nodes_object);
    const auto shown = array_of<const float, 3>(shown_object, "shown");
    const auto pixels = array_of<const uint8_t, 3>(pixels_object, "pixels");
    const auto alpha = array_of<const uint8_t, 2>(alpha_object, "alpha");
    const size_t slots = sums.shape(1);
    const bool fits = sums.shape(0) == SUMS && sums.shape(2) == TILE_CELLS && slot.size() == arrays.nodes.tiles
        && shown.size() == arrays.x_px.size() && pixels.shape(2) == 3;
    if (!fits) throw std::invalid_argument("sums, slot, shown or pixels: of another shape");
    const auto is_slot = [&](int64_t number) { return number >= 0 && static_cast<size_t>(number) < slots; };
    if (!std::all_of(slot.data(), slot.data() + slot.size(), is_slot)) throw std::invalid_argument("slot: beyond the sums");
    const GroundImage colours = image_of(pixels, 3), trust = image_of(alpha, 1);
    check_sizes(colours, trust);
    const float volume = nb::cast<float>(nodes_object.attr("volume"));
    const nb::gil_scoped_release unlocked;
    add_image(arrays.nodes, colours, trust, {shown.data(), volume, fullness, finest}, slot.data(), slots, sums.data());
}

// The colours and alpha (slots, TILE, TILE, 4) of sums (5, slots, TILE^2).
nb::object mean(nb::handle sums_object) {
    const auto sums = array_of<const float, 3>(sums_object, "sums");
    if (sums.shape(0) != SUMS || sums.shape(2) != TILE_CELLS) throw std::invalid_argument("sums: of another shape");
    const Made<uint8_t> rgba({sums.shape(1), TILE, TILE, 4});
    mean_of(sums.data(), sums.shape(1), rgba.data);
    return rgba.array;
}

// Grey values of an image, and whether a mask is set, at the pixels of tiles, each (T, TILE, TILE).
nb::tuple look(nb::handle nodes_object, nb::handle grey_object, nb::handle mask_object) {
    const NodeArrays arrays(nodes_object);
    const auto grey = array_of<const uint8_t, 2>(grey_object, "grey");
    const auto mask = array_of<const uint8_t, 2>(mask_object, "mask");
    const GroundImage image = image_of(grey, 1), over = image_of(mask, 1);
    check_sizes(image, over);
    const Made<float> values({arrays.nodes.tiles, TILE, TILE});
    const Made<bool> is_set({arrays.nodes.tiles, TILE, TILE});
    {
        const nb::gil_scoped_release unlocked;
        look_at_ground(arrays.nodes, image, over, values.data, is_set.data);
    }
    return nb::make_tuple(values.array, is_set.array);
}

}  // namespace

void add_ground(nb::module_& module) {
    auto ground = module.def_submodule("ground");
    ground.def(
        "add", &add, "sums"_a, "slot"_a, "nodes"_a, "shown"_a, "pixels"_a, "alpha"_a, "fullness"_a, "finest"_a);
    ground.def("mean", &mean, "sums"_a);
    ground.def("look", &look, "nodes"_a, "grey"_a, "mask"_a);
}

}  // namespace v2hdm
