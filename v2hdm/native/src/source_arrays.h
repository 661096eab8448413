// The image that pixels are looked up in, as Python has it.
#pragma once

#include "arrays.h"
#include "lattice.h"

namespace v2hdm {

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

}  // namespace v2hdm
