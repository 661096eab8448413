// Where a map's points should be in an image, and how well detections fit there; twin of
// v2hdm.localization.seeing and of the algebra in v2hdm.localization.joint.
#pragma once

#include <cstddef>
#include <cstdint>

namespace v2hdm {

constexpr int VEHICLE_STATES = 11;  // belief.VEHICLE
constexpr int CAMERA_STATES = 6;  // belief.CAMERA
constexpr int IMAGE_STATES = VEHICLE_STATES + CAMERA_STATES;  // those that all points of an image depend on
constexpr int PAIR = 8;  // coordinates of a quadrilateral's corners

// A camera on a vehicle in the map; transforms are (4, 4), row by row.
struct SeeingCamera {
    double rotation[3][3];  // map_from_vehicle
    double place[3];
    double turn[3][3];  // cam_from_vehicle, its error by a tangent included
    double shift[3];
    double intrinsic[2][3];

    SeeingCamera(
        const double* map_from_vehicle, const double* cam_from_vehicle, const double* tangent, const double* matrix);
};

// What a point shows: pixel, depth, and derivatives by the states of vehicle and camera and by its place.
struct SeenPoint {
    double* px;  // (2)
    double* depth_m;  // (1)
    double* by_states;  // (2, IMAGE_STATES)
    double* by_place;  // (2, 2)
};

void expect_point(const SeeingCamera& camera, const double* point_map, double nearest_m, const SeenPoint& out);

// The whitened states' part in pixels: roots of a belief, and where a marking's two states begin, -1 for none.
struct Roots {
    const double* root;  // (n, width)
    size_t width;
    size_t camera_begin;  // the first of the camera's states
};

// out (PAIR, width) = by_states (PAIR, IMAGE_STATES) and by_place (PAIR, 2) times the roots of these states.
void spread_pair(const Roots& roots, const double* by_states, const double* by_place, int64_t state, double* out);

// out (PAIR, PAIR) = factor * covariance, its rows in an order, + the map's (PAIR, PAIR) in pixels.
void noise_pair(
    const double* covariance, const int64_t* order, double factor, const double* map_m2, const double* by_place,
    double* out);

// Lower factor of a symmetric (PAIR, PAIR) in place, with the diagonal's inverses; false where it has none.
bool factor_pair(double* matrix);

// x (PAIR, width) = factor^-1 x, for factors of factor_pair.
void whiten_pair(const double* factor, double* x, size_t width);

}  // namespace v2hdm
