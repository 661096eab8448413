// Connected elements of a mask, as OpenCV finds them.
#pragma once

#include <cstdint>
#include <vector>

namespace v2hdm {

// A connected set of elements: the rectangle around it, how many there are, and the first, row by row.
struct Component {
    int left, top, right, bottom;  // the last two are beyond it
    int64_t elements;
    int first_row, first_column;
};

// Elements of a row that follow each other, and the number of their component, from 0 on.
struct Run {
    int row, first, last;  // the last is beyond it
    int32_t component;
};

struct Components {
    std::vector<Run> runs;               // row by row
    std::vector<Component> components;   // in the order of their first elements

    // Of the elements (height, width) that are not 0; those that touch at a corner are connected if ``diagonal``.
    Components(const uint8_t* mask, int height, int width, bool diagonal);
};

}  // namespace v2hdm
