// Pictures of markings for the classifier; twin of v2hdm.detection.evidence.rectified_views.
#pragma once

#include <cstdint>
#include <vector>

#include "bilinear.h"
#include "lattice.h"

namespace v2hdm {

constexpr int VIEW_SIZE = 20;  // rows and columns of a picture
constexpr int VIEW_FINER = 2;  // samples of the image per element, in each direction
constexpr int VIEW_CELLS = VIEW_SIZE * VIEW_SIZE;
constexpr int VIEW_SAMPLES = VIEW_CELLS * VIEW_FINER * VIEW_FINER;

// What the network says, from an image row on.
struct Claims {
    const float* paint;  // (height, width) log odds
    int height, width, stride;
    const float* kinds;  // (classes, kind_height, kind_width) logits
    int classes, kind_height, kind_width;
    double kind_scale;   // elements of the paint per element of the classes
    int top;             // the first image row
    int line;            // which class is lane lines
    const bool* symbol;  // which classes are symbols
};

// Factors that bring a picture's channels to about one.
struct ViewGains {
    float grey, colour, odds;
};

// Looks at pictures one after the other; the channels of the last are arrays of its elements, row by row.
class Viewer {
  public:
    float log_grey[VIEW_CELLS], blueness[VIEW_CELLS], paint_odds[VIEW_CELLS], line_share[VIEW_CELLS],
        symbol_share[VIEW_CELLS], outside[VIEW_CELLS];
    std::vector<float> shares;  // (classes, elements)

    Viewer(const Source& source, const Claims& claims, const ViewGains& gains);

    // Look at the elements (x, y) of a picture, and at the finer samples of the image, row by row as well.
    void look(const float* points, const float* finer);

  private:
    void look_at_image(const float* finer);
    void ask_network(const float* points);

    const Source& source_;
    const Claims& claims_;
    const ViewGains& gains_;
    Places samples_, cells_;
    std::vector<float> radiance_;  // (samples, 3)
};

}  // namespace v2hdm
