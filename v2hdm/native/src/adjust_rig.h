// A whitening, and evaluations under it, of a problem in which cameras alone move: at once, what
// v2hdm.adjust.whitening does in steps and explains. Of v2hdm.adjust.kernels.rig.
#pragma once

#include <memory>
#include <vector>

#include "adjust.h"
#include "adjust_tables.h"

namespace v2hdm::adjust {

using Numbers = std::vector<double>;

// Cameras on a vehicle whose recorded poses are exact, with their priors; see arrays.Arrays.
struct Rig {
    Index cameras, frames;
    const double *vehicle_from_map, *centre, *centre_root, *ground_plane, *ground_root;
    Series exp, left_jacobian;

    Index unknowns() const { return 6 * cameras; }
    Index pairs() const { return cameras * frames; }
};

// The parts of the cost.
struct Terms {
    double observations = 0, camera_centre = 0, ground_planes = 0, control_points = 0, known_lengths = 0;
};

// What a pass adds up by chunk; some of it only where the problem is linearised.
struct ChunkSums {
    Numbers costs, wrench, carried, squares, tip, failed;

    ChunkSums(const Layout& layout, const Rig& rig, bool is_linearised);
};

// The factorised Hessian at one estimate. First all chunks are eliminated, in any order, then it is factorised.
class RigWhitening {
  public:
    RigWhitening(
        const Layout& layout, const Rig& rig, const double* cam_from_vehicle, const double* corners, int code,
        double scale);

    void eliminate(Index begin, Index end);

    // Whether every block of joined corners is definite.
    bool is_separable() const;

    // The extrinsics stay where they are, if held; false if the cameras' information is not definite.
    bool factorise(bool hold_cameras);

    // From the cameras' whitened variables (D,) to their step.
    void substitute_back(double* step) const;

    const Layout& layout;
    const Rig& rig;
    const Numbers cam_from_vehicle, corners;
    Numbers table, lower, joint, rows;  // of layout.Base
    Numbers tip;                        // lower factor of the cameras' information; the identity if held
    Numbers held;                       // that information, if held
    Numbers by_camera, coupled;         // the cost's gradient by the cameras' tangents, and W V^-1 g
    Numbers gradient;                   // by the whitened variables: cameras, then corners
    double smallest_pivot = 0;
    Terms terms;
    Base base;

  private:
    void subtract_corners(Numbers& information);

    std::unique_ptr<ChunkSums> sums;
};

// The cost after a step of the whitened variables. First it looks at all chunks, in any order.
class RigEvaluation {
  public:
    RigEvaluation(const RigWhitening& whitening, const double* whitened);

    void look(Index begin, Index end);
    void finish();  // and forget what only the passes need
    const Layout& layout() const { return whitening.layout; }

    Numbers cam_from_vehicle, corners;  // moved
    Numbers gradient;
    Terms terms;

  private:
    struct Work {
        Numbers whitened, step, chart, table;
        ChunkSums sums;

        Work(const RigWhitening& whitening, const double* whitened);
    };

    const RigWhitening& whitening;
    std::unique_ptr<Work> work;
};

}  // namespace v2hdm::adjust
