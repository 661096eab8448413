#include "components.h"

#include <algorithm>
#include <cstring>

namespace v2hdm {
namespace {

constexpr int EIGHT = 8;  // elements that are compared at once

// The first place from ``at`` on whose element is ``value`` (0 or 1), or the width.
int next_of(const uint8_t* row, int at, int width, uint8_t value) {
    const uint64_t others = value ? 0 : 0x0101010101010101u;
    for (; at + EIGHT <= width; at += EIGHT) {
        uint64_t eight;
        std::memcpy(&eight, row + at, sizeof eight);
        if (eight != others) break;
    }
    while (at < width && row[at] != value) ++at;
    return at;
}

// Sets that are joined two by two; of each the least number stands for all.
struct Sets {
    std::vector<int32_t> parent;

    int32_t root(int32_t k) {
        while (parent[k] != k) k = parent[k] = parent[parent[k]];
        return k;
    }

    void join(int32_t a, int32_t b) {
        a = root(a);
        b = root(b);
        parent[std::max(a, b)] = std::min(a, b);
    }
};

std::vector<Run> runs_of(const uint8_t* mask, int height, int width) {
    std::vector<Run> runs;
    for (int i = 0; i < height; ++i) {
        const uint8_t* row = mask + static_cast<size_t>(i) * width;
        for (int j = next_of(row, 0, width, 1); j < width;) {
            const int last = next_of(row, j, width, 0);
            runs.push_back({i, j, last, 0});
            j = next_of(row, last, width, 1);
        }
    }
    return runs;
}

}  // namespace

Components::Components(const uint8_t* mask, int height, int width, bool diagonal) : runs(runs_of(mask, height, width)) {
    Sets sets;
    const int reach = diagonal ? 1 : 0;
    size_t above = 0;  // the first run of the row above that may touch
    for (size_t r = 0; r < runs.size(); ++r) {
        sets.parent.push_back(static_cast<int32_t>(r));
        const Run& run = runs[r];
        while (above < r && (runs[above].row < run.row - 1 || (runs[above].row == run.row - 1 && runs[above].last + reach <= run.first))) {
            ++above;
        }
        for (size_t k = above; k < r && runs[k].row == run.row - 1 && runs[k].first < run.last + reach; ++k) {
            sets.join(static_cast<int32_t>(k), static_cast<int32_t>(r));
        }
    }
    for (size_t r = 0; r < runs.size(); ++r) {
        Run& run = runs[r];
        const int32_t root = sets.root(static_cast<int32_t>(r));
        if (root == static_cast<int32_t>(r)) {
            run.component = static_cast<int32_t>(components.size());
            components.push_back({run.first, run.row, run.last, run.row + 1, 0, run.row, run.first});
        } else {
            run.component = runs[root].component;
        }
        Component& component = components[run.component];
        component.left = std::min(component.left, run.first);
        component.right = std::max(component.right, run.last);
        component.bottom = run.row + 1;
        component.elements += run.last - run.first;
    }
}

}  // namespace v2hdm
