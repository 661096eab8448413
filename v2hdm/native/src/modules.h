// The parts of the module that Python imports.
#pragma once

#include <nanobind/nanobind.h>

namespace v2hdm {

void add_settle(nanobind::module_& module);
void add_lattice(nanobind::module_& module);
void add_lanes(nanobind::module_& module);
void add_paint(nanobind::module_& module);
void add_pieces(nanobind::module_& module);
void add_views(nanobind::module_& module);
void add_lens(nanobind::module_& module);
void add_ground(nanobind::module_& module);
void add_seeing(nanobind::module_& module);
void add_adjust(nanobind::module_& module);
void add_adjust_rig(nanobind::module_& adjust);

}  // namespace v2hdm
