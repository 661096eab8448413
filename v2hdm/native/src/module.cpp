// The module that Python imports.
#include "modules.h"

NB_MODULE(_kernels, module) {
    module.attr("SOURCES") = V2HDM_SOURCES;
    v2hdm::add_settle(module);
    v2hdm::add_lattice(module);
    v2hdm::add_lanes(module);
    v2hdm::add_paint(module);
    v2hdm::add_lens(module);
    v2hdm::add_adjust(module);
}
