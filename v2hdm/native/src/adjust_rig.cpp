#include "adjust_rig.h"

#include <algorithm>
#include <cmath>

namespace v2hdm::adjust {
namespace {

// layout.Scratch.of.
struct Workspace {
    std::vector<int32_t> slot;
    Numbers coupling, observed, block, step, gradient, rows;
    Scratch view;

    Workspace(const Layout& layout, Index pairs, Index width)
        : slot(pairs), coupling(12 * layout.most_seen), observed(8 * layout.most_seen),
          block(4 * layout.most_joined * layout.most_joined), step(2 * layout.most_joined),
          gradient(2 * layout.most_joined), rows(2 * layout.most_joined * width),
          view{slot.data(), coupling.data(), observed.data(), block.data(), step.data(), gradient.data(),
               rows.data(), 2 * layout.most_joined, width} {}
};

Index joint_size(const Layout& layout) {
    Index size = 0;
    for (Index u = 0; u < layout.units; ++u) {
        const Index joined = layout.unit[u + 1] - layout.unit[u];
        if (joined > 1) size = std::max(size, layout.joint_at[u] + 4 * joined * joined);
    }
    return size;
}

// A prior on an extrinsic: three residuals, and their derivatives by its left tangent.
struct Prior {
    double residual[3] = {}, jacobian[3][6] = {};

    // Adds its gradient and, if there is one, its block in a matrix of rows of ``width``; returns its cost.
    double add(double* gradient, double* block, Index width) const {
        double cost = 0;
        for (int i = 0; i < 3; ++i) {
            cost += residual[i] * residual[i] / 2;
            for (int p = 0; p < 6; ++p) {
                gradient[p] += jacobian[i][p] * residual[i];
                for (int s = 0; block && s <= p; ++s) block[p * width + s] += jacobian[i][p] * jacobian[i][s];
            }
        }
        return cost;
    }
};

// A left tangent moves the camera's centre by minus its translation, in the vehicle's axes.
Prior centre_prior(const Rig& rig, Index c, const double* t) {
    Prior prior;
    for (int i = 0; i < 3; ++i) {
        const double root = rig.centre_root[3 * c + i];
        const double centre = -(t[i] * t[3] + t[4 + i] * t[7] + t[8 + i] * t[11]);
        prior.residual[i] = (centre - rig.centre[3 * c + i]) * root;
        for (int p = 0; p < 3; ++p) prior.jacobian[i][p] = -t[4 * p + i] * root;
    }
    return prior;
}

// model.ground_residual, and model.by_ground_planes times its root information.
Prior ground_prior(const Rig& rig, Index c, const double* t) {
    const double x = t[2], y = t[6], z = t[10];
    const double plane[4] = {x, y, z, -(x * t[3] + y * t[7] + z * t[11])};
    const double by_tangent[4][6] = {
        {0, 0, 0, 0, z, -y}, {0, 0, 0, -z, 0, x}, {0, 0, 0, y, -x, 0}, {-x, -y, -z, 0, 0, 0}};
    Prior prior;
    for (int i = 0; i < 3; ++i) {
        for (int k = 0; k < 4; ++k) {
            const double root = rig.ground_root[12 * c + 4 * i + k];
            prior.residual[i] += root * (plane[k] - rig.ground_plane[4 * c + k]);
            for (int p = 0; p < 6; ++p) prior.jacobian[i][p] += root * by_tangent[k][p];
        }
    }
    return prior;
}

// Adds the priors of extrinsics to cost, gradient (D,) and, if there is one, information (D, D).
void add_priors(
    const Rig& rig, const double* cam_from_vehicle, Terms& terms, double* gradient, double* information) {
    const Index width = rig.unknowns();
    for (Index c = 0; c < rig.cameras; ++c) {
        double* block = information ? information + 6 * c * (width + 1) : nullptr;
        const double* transform = cam_from_vehicle + 16 * c;
        terms.camera_centre += centre_prior(rig, c, transform).add(gradient + 6 * c, block, width);
        terms.ground_planes += ground_prior(rig, c, transform).add(gradient + 6 * c, block, width);
    }
}

Terms observed_terms(const Layout& layout, const ChunkSums& sums) {
    Terms terms;
    for (Index q = 0; q < layout.chunks; ++q) {
        terms.observations += sums.costs[3 * q];
        terms.control_points += sums.costs[3 * q + 1];
        terms.known_lengths += sums.costs[3 * q + 2];
    }
    return terms;
}

// Adds up wrenches by camera.
void gather_wrenches(const Layout& layout, const ChunkSums& sums, double* by_camera) {
    for (Index i = 0; i < layout.touched_at[layout.chunks]; ++i) {
        double* sum = by_camera + 6 * (layout.touched[i] / layout.moments);
        for (int p = 0; p < 6; ++p) sum[p] += sums.wrench[6 * i + p];
    }
}

// Adds up parts of so many numbers.
void add_parts(const Numbers& parts, Numbers& out) {
    for (size_t i = 0; i < parts.size(); ++i) out[i % out.size()] += parts[i];
}

// Replaces the lower triangle of a matrix by its factor, and the upper by zeros; false if it is not definite.
bool factorise_lower(double* matrix, Index size) {
    for (Index i = 0; i < size; ++i) {
        double* row = matrix + i * size;
        for (Index j = 0; j <= i; ++j) {
            const double* other = matrix + j * size;
            double remainder = row[j];
            for (Index m = 0; m < j; ++m) remainder -= row[m] * other[m];
            if (j < i) {
                row[j] = remainder / other[j];
            } else if (remainder > 0) {
                row[i] = std::sqrt(remainder);
            } else {
                return false;
            }
        }
        std::fill(row + i + 1, row + size, 0.0);
    }
    return true;
}

Factor factor_of(const Numbers& tip, Index size) {
    Factor factor = {};
    factor.tip_size = size;
    factor.tip = tip.data();
    return factor;
}

}  // namespace

ChunkSums::ChunkSums(const Layout& layout, const Rig& rig, bool is_linearised)
    : costs(3 * layout.chunks), wrench(6 * layout.touched_at[layout.chunks]), carried(layout.chunks * rig.unknowns()) {
    if (!is_linearised) return;
    squares.resize(21 * layout.chunks * rig.cameras);
    tip.resize(layout.chunks * rig.unknowns() * rig.unknowns());
    failed.resize(layout.chunks);
}

RigWhitening::RigWhitening(
    const Layout& layout, const Rig& rig, const double* cam_from_vehicle, const double* corners, int code,
    double scale)
    : layout(layout), rig(rig), cam_from_vehicle(cam_from_vehicle, cam_from_vehicle + 16 * rig.cameras),
      corners(corners, corners + 2 * layout.corners), table(16 * rig.pairs()), lower(3 * layout.corners),
      joint(joint_size(layout)), rows(2 * layout.corners * rig.unknowns()), tip(rig.unknowns() * rig.unknowns()),
      by_camera(rig.unknowns()), coupled(rig.unknowns()), gradient(rig.unknowns() + 2 * layout.corners),
      sums(std::make_unique<ChunkSums>(layout, rig, true)) {
    compose(this->cam_from_vehicle.data(), false, rig.vehicle_from_map, rig.cameras, rig.frames, table.data());
    base = {
        table.data(), this->corners.data(), rig.pairs(), layout.corners, rig.unknowns(), code, scale, lower.data(),
        joint.data(), rows.data(), true,
    };
}

void RigWhitening::eliminate(Index begin, Index end) {
    const Workspace room(layout, rig.pairs(), rig.unknowns());
    const Linearisation out = {
        sums->costs.data(), sums->wrench.data(), nullptr, sums->carried.data(), gradient.data() + rig.unknowns(),
        sums->squares.data(), sums->tip.data(), sums->failed.data(), rig.unknowns(),
    };
    passes().linearise(begin, end, layout, base, nullptr, false, room.view, out);
}

bool RigWhitening::is_separable() const {
    return std::all_of(sums->failed.begin(), sums->failed.end(), [](double units) { return units == 0; });
}

bool RigWhitening::factorise(bool hold_cameras) {
    const Index width = rig.unknowns();
    terms = observed_terms(layout, *sums);
    gather_wrenches(layout, *sums, by_camera.data());
    add_priors(rig, cam_from_vehicle.data(), terms, by_camera.data(), tip.data());
    add_parts(sums->carried, coupled);
    Numbers information(width);
    subtract_corners(information);
    sums.reset();
    for (Index p = 0; p < width; ++p) gradient[p] = by_camera[p] - coupled[p];
    if (hold_cameras) {
        held = tip;
        for (Index p = 0; p < width; ++p) {
            for (Index s = p + 1; s < width; ++s) held[p * width + s] = held[s * width + p];
        }
        std::fill(tip.begin(), tip.end(), 0.0);
        for (Index p = 0; p < width; ++p) tip[p * (width + 1)] = 1.0;
    } else if (!factorise_lower(tip.data(), width)) {
        return false;
    }
    smallest_pivot = HUGE_VAL;
    for (Index p = 0; p < width; ++p) {
        const double pivot = tip[p * (width + 1)];
        smallest_pivot = std::min(smallest_pivot, pivot * pivot / information[p]);
    }
    passes().forward(factor_of(tip, width), gradient.data());
    return true;
}

void RigWhitening::substitute_back(double* step) const { passes().backward(factor_of(tip, rig.unknowns()), step); }

// Completes the cameras' information; ``information`` (D,) is what there is of each unknown alone.
void RigWhitening::subtract_corners(Numbers& information) {
    const Index width = rig.unknowns();
    for (Index i = 0; i < layout.chunks * rig.cameras; ++i) {
        const double* square = sums->squares.data() + 21 * i;
        double* block = tip.data() + 6 * (i % rig.cameras) * (width + 1);
        for (int p = 0; p < 6; ++p) {
            for (int s = p; s < 6; ++s) block[s * width + p] += *square++;
        }
    }
    for (Index p = 0; p < width; ++p) information[p] = tip[p * (width + 1)];
    Numbers products(width * width);
    add_parts(sums->tip, products);
    for (Index i = 0; i < width * width; ++i) tip[i] -= products[i];
}

RigEvaluation::Work::Work(const RigWhitening& whitening, const double* by)
    : whitened(by, by + whitening.gradient.size()), step(by, by + whitening.rig.unknowns()),
      chart(36 * whitening.rig.cameras), table(whitening.table.size()),
      sums(whitening.layout, whitening.rig, false) {}

RigEvaluation::RigEvaluation(const RigWhitening& whitening, const double* whitened)
    : cam_from_vehicle(whitening.cam_from_vehicle.size()), corners(whitening.corners.size()),
      gradient(whitening.gradient.size()), whitening(whitening), work(std::make_unique<Work>(whitening, whitened)) {
    const Rig& rig = whitening.rig;
    whitening.substitute_back(work->step.data());
    move(
        work->step.data(), whitening.cam_from_vehicle.data(), rig.cameras, rig.exp, rig.left_jacobian,
        cam_from_vehicle.data(), work->chart.data());
    compose(cam_from_vehicle.data(), false, rig.vehicle_from_map, rig.cameras, rig.frames, work->table.data());
}

void RigEvaluation::look(Index begin, Index end) {
    const Index width = whitening.rig.unknowns();
    const Workspace room(whitening.layout, whitening.rig.pairs(), 0);
    const Step by = {work->table.data(), nullptr, work->step.data(), work->whitened.data() + width};
    ChunkSums& sums = work->sums;
    const Evaluation out = {
        sums.costs.data(), sums.wrench.data(), nullptr, sums.carried.data(), corners.data(), gradient.data() + width,
        width,
    };
    passes().evaluate(begin, end, whitening.layout, whitening.base, by, room.view, out);
}

void RigEvaluation::finish() {
    const Rig& rig = whitening.rig;
    const Index width = rig.unknowns();
    terms = observed_terms(whitening.layout, work->sums);
    Numbers by_camera(width), coupled(width);
    gather_wrenches(whitening.layout, work->sums, by_camera.data());
    add_priors(rig, cam_from_vehicle.data(), terms, by_camera.data(), nullptr);
    add_parts(work->sums.carried, coupled);
    for (Index p = 0; p < width; ++p) {
        const double *jacobian = work->chart.data() + 36 * (p / 6), *of_camera = by_camera.data() + p / 6 * 6;
        double by_tangent = 0;
        for (int i = 0; i < 6; ++i) by_tangent += jacobian[6 * i + p % 6] * of_camera[i];
        gradient[p] = by_tangent - coupled[p];
    }
    passes().forward(factor_of(whitening.tip, width), gradient.data());
    work.reset();
}

}  // namespace v2hdm::adjust
