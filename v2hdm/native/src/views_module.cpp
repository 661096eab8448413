// What Python calls of pictures of markings.
#include <algorithm>
#include <vector>

#include "arrays.h"
#include "modules.h"
#include "source_arrays.h"
#include "views.h"

namespace v2hdm {
namespace {

using namespace nb::literals;

constexpr int CHANNELS = 7;  // of a picture: evidence.CHANNELS

// Arrays of an evidence._Claims.
struct ClaimArrays {
    Array<const float, 2> paint;
    Array<const float, 3> kinds;
    Array<const bool, 1> symbol;
    Claims claims;

    explicit ClaimArrays(nb::handle object)
        : paint(array_of<const float, 2>(object.attr("paint"), "paint")),
          kinds(array_of<const float, 3>(object.attr("kinds"), "kinds")),
          symbol(member<const bool, 1>(object, "is_symbol", {kinds.shape(0)})) {
        claims = {
            paint.data(), static_cast<int>(paint.shape(0)), static_cast<int>(paint.shape(1)),
            nb::cast<int>(object.attr("stride")), kinds.data(), static_cast<int>(kinds.shape(0)),
            static_cast<int>(kinds.shape(1)), static_cast<int>(kinds.shape(2)),
            nb::cast<double>(object.attr("kind_scale")), nb::cast<int>(object.attr("top")),
            nb::cast<int>(object.attr("line")), symbol.data(),
        };
        const bool is_usable = paint.size() > 0 && kinds.size() > 0 && claims.stride > 0 && claims.kind_scale > 0;
        if (!is_usable || claims.line < 0 || claims.line >= claims.classes) {
            throw std::invalid_argument("claims: of another shape");
        }
    }
};

// Write the channels of a picture, with the share of one class as a reading's own.
void write(const Viewer& seen, int own_class, float* into) {
    const float* channels[CHANNELS] = {
        seen.log_grey, seen.blueness, seen.paint_odds, seen.shares.data() + static_cast<size_t>(own_class) * VIEW_CELLS,
        seen.line_share, seen.symbol_share, seen.outside,
    };
    for (const float* channel : channels) into = std::copy(channel, channel + VIEW_CELLS, into);
}

nb::object views_of(
    nb::handle source_object, nb::handle claims_object, nb::handle points_object, nb::handle finer_object,
    nb::handle picture_object, nb::handle class_object, float grey_gain, float colour_gain, float odds_gain) {
    const SourceArrays source(source_object);
    const ClaimArrays claims(claims_object);
    const auto points = array_of<const float, 4>(points_object, "points");
    const auto finer = array_of<const float, 4>(finer_object, "finer");
    const auto picture = array_of<const int64_t, 1>(picture_object, "picture");
    const auto own_class = array_of<const int64_t, 1>(class_object, "own_class");
    const size_t pictures = points.shape(0), readings = picture.shape(0);
    const bool is_usable = points.size() == pictures * VIEW_CELLS * 2 && finer.size() == pictures * VIEW_SAMPLES * 2
        && finer.shape(0) == pictures && own_class.shape(0) == readings;
    if (!is_usable) throw std::invalid_argument("points: of another shape");
    for (size_t r = 0; r < readings; ++r) {
        const int64_t p = picture.data()[r], k = own_class.data()[r];
        if (p < 0 || p >= static_cast<int64_t>(pictures) || k < 0 || k >= claims.claims.classes) {
            throw std::invalid_argument("picture and own_class: of another range");
        }
    }
    const size_t size = CHANNELS * VIEW_CELLS;
    const Made<float> made({readings, CHANNELS, VIEW_SIZE, VIEW_SIZE});
    {
        const nb::gil_scoped_release unlocked;
        const ViewGains gains = {grey_gain, colour_gain, odds_gain};
        Viewer viewer(source.source, claims.claims, gains);
        for (size_t p = 0; p < pictures; ++p) {
            viewer.look(points.data() + p * VIEW_CELLS * 2, finer.data() + p * VIEW_SAMPLES * 2);
            for (size_t r = 0; r < readings; ++r) {
                if (picture.data()[r] != static_cast<int64_t>(p)) continue;
                write(viewer, static_cast<int>(own_class.data()[r]), made.data + r * size);
            }
        }
    }
    return made.array;
}

}  // namespace

void add_views(nb::module_& module) {
    module.def(
        "views", &views_of, "source"_a, "claims"_a, "points"_a, "finer"_a, "picture"_a, "own_class"_a, "grey_gain"_a,
        "colour_gain"_a, "odds_gain"_a);
}

}  // namespace v2hdm
