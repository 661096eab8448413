// The module that Python imports.
#include "modules.h"

NB_MODULE(_kernels, module) {
    module.attr("SOURCES") = V2HDM_SOURCES;
    // A solution that lives until the process ends is no leak.
    nanobind::set_leak_warnings(false);
    v2hdm::add_settle(module);
    v2hdm::add_lattice(module);
    v2hdm::add_lanes(module);
    v2hdm::add_paint(module);
    v2hdm::add_pieces(module);
    v2hdm::add_views(module);
    v2hdm::add_lens(module);
    v2hdm::add_ground(module);
    v2hdm::add_seeing(module);
    v2hdm::add_adjust(module);
}
