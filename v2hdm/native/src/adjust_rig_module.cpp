// Whitening and evaluation at once, as Python calls them; arrays are views that keep their objects alive.
#include "adjust_rig.h"
#include "adjust_records.h"
#include "modules.h"

#include <algorithm>

namespace v2hdm {
namespace {

using namespace adjust;

Series series_of(const In<double, 2>& terms) { return {terms.data(), size_of(terms.shape(0)), size_of(terms.shape(1))}; }

// The problem: its layout, and what kernels.rig.Parts holds.
struct RigProblem {
    LayoutRecord layout;
    In<double, 3> vehicle_from_map, ground_root;
    In<double, 2> centre, centre_root, ground_plane, exp, left_jacobian;
    Rig view;

    RigProblem(nb::handle layout_record, nb::handle parts)
        : layout(layout_record), vehicle_from_map(member<const double, 3>(parts, "vehicle_from_map", {})),
          ground_root(member<const double, 3>(parts, "ground_root", {})),
          centre(member<const double, 2>(parts, "centre", {ground_root.shape(0), 3})),
          centre_root(member<const double, 2>(parts, "centre_root", {ground_root.shape(0), 3})),
          ground_plane(member<const double, 2>(parts, "ground_plane", {ground_root.shape(0), 4})),
          exp(member<const double, 2>(parts, "exp_series", {})),
          left_jacobian(member<const double, 2>(parts, "jacobian_series", {})) {
        require(ground_root.shape(1) == 3 && ground_root.shape(2) == 4, "ground_root");
        require(size_of(vehicle_from_map.shape(0)) == layout.view.moments, "vehicle_from_map");
        view = {
            size_of(ground_root.shape(0)), layout.view.moments, vehicle_from_map.data(), centre.data(),
            centre_root.data(), ground_plane.data(), ground_root.data(), series_of(exp), series_of(left_jacobian),
        };
    }
};

RigWhitening* linearised(
    const RigProblem& problem, nb::handle cameras_object, nb::handle corners_object, int code, double scale) {
    const auto cameras = array_of<const double, 3>(cameras_object, "cam_from_vehicle");
    const auto corners = array_of<const double, 2>(corners_object, "corners_map");
    const Layout& layout = problem.layout.view;
    require(size_of(cameras.size()) == 16 * problem.view.cameras, "cam_from_vehicle");
    require(size_of(corners.size()) == 2 * layout.corners, "corners_map");
    return new RigWhitening(layout, problem.view, cameras.data(), corners.data(), code, scale);
}

RigEvaluation* evaluated(const RigWhitening& whitening, nb::handle whitened_object) {
    const auto whitened = array_of<const double, 1>(whitened_object, "whitened");
    require(whitened.size() == whitening.gradient.size(), "whitened");
    return new RigEvaluation(whitening, whitened.data());
}

// The cameras' part (D,) of a step: they come last, and need no other variables.
nb::object camera_step(const RigWhitening& whitening, nb::handle whitened_object) {
    const auto whitened = array_of<const double, 1>(whitened_object, "whitened");
    require(whitened.size() == whitening.gradient.size(), "whitened");
    const size_t unknowns = whitening.by_camera.size();
    const Made<double> step({unknowns});
    std::copy(whitened.data(), whitened.data() + unknowns, step.data);
    whitening.substitute_back(step.data);
    return step.array;
}

// Numbers of an object as an array.
template <typename Owner>
auto view_of(Numbers Owner::*numbers) {
    return [numbers](nb::handle self) {
        Numbers& values = nb::inst_ptr<Owner>(self)->*numbers;
        return nb::ndarray<nb::numpy, double, nb::ndim<1>>(values.data(), {values.size()}, self);
    };
}

nb::tuple costs_of(const Terms& terms) {
    return nb::make_tuple(
        terms.observations, terms.camera_centre, terms.ground_planes, terms.control_points, terms.known_lengths);
}

nb::tuple costs_of_whitening(const RigWhitening& whitening) { return costs_of(whitening.terms); }

// An array that keeps its numbers alive itself.
nb::object owned(Numbers&& numbers, std::initializer_list<size_t> shape) {
    auto* kept = new Numbers(std::move(numbers));
    const nb::capsule owner(kept, [](void* memory) noexcept { delete static_cast<Numbers*>(memory); });
    return nb::cast(nb::ndarray<nb::numpy, double>(kept->data(), shape, owner));
}

// What kernels.rig.Evaluated holds. Views would keep the factors alive for as long as the solution.
nb::tuple finished(RigEvaluation& evaluation) {
    evaluation.finish();
    const size_t cameras = evaluation.cam_from_vehicle.size() / 16, corners = evaluation.corners.size() / 2;
    const size_t unknowns = evaluation.gradient.size();
    return nb::make_tuple(
        costs_of(evaluation.terms), owned(std::move(evaluation.cam_from_vehicle), {cameras, 4, 4}),
        owned(std::move(evaluation.corners), {corners, 2}), owned(std::move(evaluation.gradient), {unknowns}));
}

template <typename Owner, void (Owner::*WORK)(Index, Index)>
void over_chunks(Owner& owner, Index begin, Index end, const Layout& layout) {
    require(0 <= begin && begin <= end && end <= layout.chunks, "chunks");
    const nb::gil_scoped_release release;
    (owner.*WORK)(begin, end);
}

void eliminate(RigWhitening& whitening, Index begin, Index end) {
    over_chunks<RigWhitening, &RigWhitening::eliminate>(whitening, begin, end, whitening.layout);
}

void look(RigEvaluation& evaluation, Index begin, Index end) {
    over_chunks<RigEvaluation, &RigEvaluation::look>(evaluation, begin, end, evaluation.layout());
}

}  // namespace

void add_adjust_rig(nb::module_& adjust) {
    nb::class_<RigProblem>(adjust, "Rig")
        .def(nb::init<nb::handle, nb::handle>())
        .def("linearise", &linearised, nb::keep_alive<0, 1>(), nb::rv_policy::take_ownership);
    nb::class_<RigWhitening>(adjust, "RigWhitening")
        .def("eliminate", &eliminate)
        .def("is_separable", &RigWhitening::is_separable)
        .def("factorise", &RigWhitening::factorise)
        .def("camera_step", &camera_step)
        .def("evaluate", &evaluated, nb::keep_alive<0, 1>(), nb::rv_policy::take_ownership)
        .def_ro("smallest_pivot", &RigWhitening::smallest_pivot)
        .def_prop_ro("costs", &costs_of_whitening)
        .def_prop_ro("table", view_of(&RigWhitening::table))
        .def_prop_ro("lower", view_of(&RigWhitening::lower))
        .def_prop_ro("joint", view_of(&RigWhitening::joint))
        .def_prop_ro("rows", view_of(&RigWhitening::rows))
        .def_prop_ro("tip", view_of(&RigWhitening::tip))
        .def_prop_ro("held", view_of(&RigWhitening::held))
        .def_prop_ro("by_camera", view_of(&RigWhitening::by_camera))
        .def_prop_ro("coupled", view_of(&RigWhitening::coupled))
        .def_prop_ro("gradient", view_of(&RigWhitening::gradient));
    nb::class_<RigEvaluation>(adjust, "RigEvaluation")
        .def("look", &look)
        .def("finish", &finished);
}

}  // namespace v2hdm
