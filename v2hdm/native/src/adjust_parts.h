// Parts of the adjustment's passes; twin of v2hdm.adjust.kernels.inline.
namespace v2hdm::adjust {
namespace {

constexpr double LARGE = 1e150;  // inline._LARGE

struct Seen {
    double px, py, pz, inverse, slope, u, v;
};

// Observation k of the ground point x, y.
inline Seen see(const Layout& layout, const double* table, Index k, double x, double y) {
    const double* t = table + 16 * layout.pair[k];
    Seen seen;
    seen.px = t[0] * x + t[1] * y + t[3];
    seen.py = t[4] * x + t[5] * y + t[7];
    seen.pz = t[8] * x + t[9] * y + t[11];
    const double at_least = !(seen.pz < NEAR_M) ? seen.pz : NEAR_M;
    const double reciprocal = 1.0 / at_least;
    seen.slope = -reciprocal * reciprocal;
    seen.inverse = reciprocal + seen.slope * (seen.pz - at_least);
    seen.u = seen.px * seen.inverse - layout.measured[k];
    seen.v = seen.py * seen.inverse - layout.measured[layout.observations + k];
    return seen;
}

inline Index first_corner(const Layout& layout, Index chunk) { return layout.unit[layout.chunk[chunk]]; }

struct Root {
    double a, b, c;
};

inline Root root_of(const Layout& layout, Index k) {
    return {layout.root[k], layout.root[layout.observations + k], layout.root[2 * layout.observations + k]};
}

inline double weigh(const Base& base, double squared) {
    if (base.code == NONE) return 1.0;
    const double cut = base.scale * base.scale;
    if (base.code == HUBER) return squared <= cut ? 1.0 : base.scale / std::sqrt(squared);
    const double weight = cut / (cut + squared);
    return base.code == CAUCHY ? weight : weight * weight;
}

inline double floored(double weight) { return weight < WEIGHT_FLOOR ? WEIGHT_FLOOR : weight; }

// A sum of losses; those of Cauchy as a product, whose logarithm is taken once.
struct LossSum {
    double total = 0.0, product = 1.0;

    void add(const Base& base, double squared) {
        if (base.code == NONE) {
            total += squared;
            return;
        }
        const double cut = base.scale * base.scale;
        if (base.code == HUBER) {
            total += squared <= cut ? squared : 2 * base.scale * std::sqrt(squared) - cut;
            return;
        }
        const double ratio = squared / cut;
        if (base.code == GEMAN_MCCLURE) {
            total += squared / (1 + ratio);
            return;
        }
        if (!(ratio < LARGE)) {
            total += cut * std::log1p(ratio);
            return;
        }
        product *= 1 + ratio;
        if (product > LARGE) {
            total += cut * std::log(product);
            product = 1.0;
        }
    }

    double cost(const Base& base) const {
        const double last = base.code == CAUCHY ? base.scale * base.scale * std::log(product) : 0.0;
        return (total + last) / 2;
    }
};

inline void add_force(double* wrench, double px, double py, double pz, double fx, double fy, double fz) {
    wrench[0] += fx;
    wrench[1] += fy;
    wrench[2] += fz;
    wrench[3] += py * fz - pz * fy;
    wrench[4] += pz * fx - px * fz;
    wrench[5] += px * fy - py * fx;
}

struct LengthResidual {
    double residual, jx, jy;
};

inline LengthResidual length_residual(const Layout& layout, Index m, const double* corners) {
    const double* first = corners + 2 * layout.length_first[m];
    const double* second = corners + 2 * layout.length_second[m];
    const double dx = first[0] - second[0], dy = first[1] - second[1];
    const double distance = std::sqrt(dx * dx + dy * dy);
    const double root = layout.length_root[m];
    const double over = distance > 0 ? root / distance : 0.0;
    return {(distance - layout.length_m[m]) * root, dx * over, dy * over};
}

// Adds a unit's survey and known lengths to its gradient, and to costs[1] and costs[2].
inline void add_corner_priors(
    const Layout& layout, Index u, const double* corners, double* gradient, double* costs) {
    const Index first = layout.unit[u];
    for (Index c = first; c < layout.unit[u + 1]; ++c) {
        const double *root = layout.control_root + 3 * c, *control = layout.control + 2 * c;
        if (!(root[0] > 0 || root[2] > 0)) continue;
        const double dx = corners[2 * c] - control[0];
        const double top = root[0] * dx;
        const double low = root[1] * dx + root[2] * (corners[2 * c + 1] - control[1]);
        gradient[2 * (c - first)] += root[0] * top + root[1] * low;
        gradient[2 * (c - first) + 1] += root[2] * low;
        costs[1] += (top * top + low * low) / 2;
    }
    for (Index m = layout.length_at[u]; m < layout.length_at[u + 1]; ++m) {
        const LengthResidual length = length_residual(layout, m, corners);
        double* a = gradient + 2 * (layout.length_first[m] - first);
        double* b = gradient + 2 * (layout.length_second[m] - first);
        a[0] += length.jx * length.residual;
        a[1] += length.jy * length.residual;
        b[0] -= length.jx * length.residual;
        b[1] -= length.jy * length.residual;
        costs[2] += length.residual * length.residual / 2;
    }
}

// A unit: twice its number of corners, its first corner, and the offset of its factor if joined.
struct Unit {
    Index n, c, at;
};

inline Unit unit_of(const Layout& layout, Index u) {
    const Index first = layout.unit[u];
    return {2 * (layout.unit[u + 1] - first), first, layout.joint_at[u]};
}

// L of a single corner, [first 0; below last].
struct Lower {
    double &first, &below, &last;

    Lower(const Base& base, Index c)
        : first(base.lower[c]), below(base.lower[base.corner_count + c]), last(base.lower[2 * base.corner_count + c]) {}
};

// Factorises a unit's block into ``base.lower``, or ``base.joint`` for joined corners; false if it is singular.
inline bool factorise_unit(const Layout& layout, const Base& base, Index u, const Scratch& scratch) {
    const auto [n, c, at] = unit_of(layout, u);
    double* block = scratch.block;
    const Index columns = scratch.block_columns;
    for (Index i = 0; i < n; ++i) block[i * columns + i] += CORNER_FLOOR;
    if (n == 2) {
        Lower lower(base, c);
        const double first = std::sqrt(block[0]), last2 = block[columns + 1];
        const double below = block[columns] / first;
        const double remainder = last2 - below * below, least = PIVOT_FLOOR * last2;
        lower.first = first;
        lower.below = below;
        lower.last = std::sqrt(remainder < least ? least : remainder);
        return true;
    }
    for (Index i = 0; i < n / 2; ++i) {
        Lower lower(base, c + i);
        lower.first = 1.0;
        lower.below = 0.0;
        lower.last = 1.0;
    }
    double* joint = base.joint + at;
    for (Index i = 0; i < n; ++i) {
        for (Index j = 0; j <= i; ++j) {
            double remainder = block[i * columns + j];
            for (Index m = 0; m < j; ++m) remainder -= joint[i * n + m] * joint[j * n + m];
            if (j < i) {
                joint[i * n + j] = remainder / joint[j * n + j];
            } else if (remainder > 0) {
                joint[i * n + i] = std::sqrt(remainder);
            } else {
                return false;
            }
        }
        for (Index j = i + 1; j < n; ++j) joint[i * n + j] = 0.0;
    }
    return true;
}

// Writes a unit's block, unfactorised, in place of its factor.
inline void keep_unit(const Layout& layout, const Base& base, Index u, const Scratch& scratch) {
    const auto [n, c, at] = unit_of(layout, u);
    double* block = scratch.block;
    const Index columns = scratch.block_columns;
    for (Index i = 0; i < n; ++i) block[i * columns + i] += CORNER_FLOOR;
    if (n == 2) {
        Lower lower(base, c);
        lower.first = block[0];
        lower.below = block[columns];
        lower.last = block[columns + 1];
        return;
    }
    for (Index i = 0; i < n; ++i) {
        for (Index j = 0; j < n; ++j) base.joint[at + i * n + j] = j <= i ? block[i * columns + j] : 0.0;
    }
}

// Replaces b (2g,) by L^-1 b.
inline void solve_unit(const Layout& layout, const Base& base, Index u, double* right) {
    const auto [n, c, at] = unit_of(layout, u);
    if (n == 2) {
        const Lower lower(base, c);
        right[0] /= lower.first;
        right[1] = (right[1] - lower.below * right[0]) / lower.last;
        return;
    }
    const double* joint = base.joint + at;
    for (Index i = 0; i < n; ++i) {
        double remainder = right[i];
        for (Index m = 0; m < i; ++m) remainder -= joint[i * n + m] * right[m];
        right[i] = remainder / joint[i * n + i];
    }
}

// Replaces b (2g,) by L^-T b.
inline void solve_unit_transposed(const Layout& layout, const Base& base, Index u, double* right) {
    const auto [n, c, at] = unit_of(layout, u);
    if (n == 2) {
        const Lower lower(base, c);
        right[1] /= lower.last;
        right[0] = (right[0] - lower.below * right[1]) / lower.first;
        return;
    }
    const double* joint = base.joint + at;
    for (Index i = n - 1; i >= 0; --i) {
        double remainder = right[i];
        for (Index m = i + 1; m < n; ++m) remainder -= joint[m * n + i] * right[m];
        right[i] = remainder / joint[i * n + i];
    }
}

// Replaces columns ``begin`` to ``end`` of a unit's rows b by L^-1 b.
inline void solve_unit_rows(
    const Layout& layout, const Base& base, Index u, const Scratch& scratch, Index begin, Index end) {
    const auto [n, c, at] = unit_of(layout, u);
    double* rows = scratch.rows;
    const Index columns = scratch.row_columns;
    if (n == 2) {
        const Lower lower(base, c);
        const double first = lower.first, below = lower.below, last = lower.last;
        double *top = rows, *low = rows + columns;
        for (Index p = begin; p < end; ++p) {
            top[p] /= first;
            low[p] = (low[p] - below * top[p]) / last;
        }
        return;
    }
    const double* joint = base.joint + at;
    for (Index i = 0; i < n; ++i) {
        double* row = rows + i * columns;
        for (Index m = 0; m < i; ++m) {
            const double factor = joint[i * n + m];
            const double* above = rows + m * columns;
            for (Index p = begin; p < end; ++p) row[p] -= factor * above[p];
        }
        const double pivot = joint[i * n + i];
        for (Index p = begin; p < end; ++p) row[p] /= pivot;
    }
}

// Gradient by a corner from the gradient f by its point in a pair of this table.
inline void along_axes(const double* t, double fx, double fy, double fz, double& x, double& y) {
    x = t[0] * fx + t[4] * fy + t[8] * fz;
    y = t[1] * fx + t[5] * fy + t[9] * fz;
}

inline void number_touched(const Layout& layout, Index q, int32_t* slot) {
    for (Index i = layout.touched_at[q]; i < layout.touched_at[q + 1]; ++i) {
        slot[layout.touched[i]] = static_cast<int32_t>(i);
    }
}

// Derivatives (16,) of an observation by its pair, row by row, and by its corner; residual and point.
struct Derived {
    double jacobian[16], r0, r1, px, py, pz;

    Derived(const Layout& layout, const double* table, Index k, double x, double y) {
        const Seen seen = see(layout, table, k, x, y);
        const auto [a, b, c] = root_of(layout, k);
        const double *t = table + 16 * layout.pair[k];
        px = seen.px, py = seen.py, pz = seen.pz;
        const double ad = a * seen.inverse, bd = b * seen.inverse, cd = c * seen.inverse;
        const double g = a * px * seen.slope, h = (b * px + c * py) * seen.slope;
        jacobian[0] = ad;
        jacobian[1] = 0.0;
        jacobian[2] = g;
        jacobian[3] = py * g;
        jacobian[4] = pz * ad - px * g;
        jacobian[5] = -py * ad;
        jacobian[6] = bd;
        jacobian[7] = cd;
        jacobian[8] = h;
        jacobian[9] = py * h - pz * cd;
        jacobian[10] = pz * bd - px * h;
        jacobian[11] = px * cd - py * bd;
        jacobian[12] = ad * t[0] + g * t[8];
        jacobian[13] = ad * t[1] + g * t[9];
        jacobian[14] = bd * t[0] + cd * t[4] + h * t[8];
        jacobian[15] = bd * t[1] + cd * t[5] + h * t[9];
        r0 = a * seen.u;
        r1 = b * seen.u + c * seen.v;
    }

    double squared() const { return r0 * r0 + r1 * r1; }

    // Writes W' (12,).
    void couple(double weight, double* out) const {
        for (int p = 0; p < 6; ++p) {
            const double top = weight * jacobian[p], low = weight * jacobian[6 + p];
            out[p] = jacobian[12] * top + jacobian[14] * low;
            out[6 + p] = jacobian[13] * top + jacobian[15] * low;
        }
    }

    // Adds J'J by the pair (21,), upper triangle row by row.
    void add_square(double weight, double* square) const {
        for (int p = 0; p < 6; ++p) {
            const double top = weight * jacobian[p], low = weight * jacobian[6 + p];
            for (int s = p; s < 6; ++s) *square++ += top * jacobian[s] + low * jacobian[6 + s];
        }
    }
};

// Adds W' (12,) of an observation to two rows at its camera's unknowns, by the pair's clock (6, unknowns - 6).
inline void add_camera(const double* coupling, const double* clock, Index unknowns, double* top, double* low) {
    const Index clocks = unknowns - 6;
    for (int p = 0; p < 6; ++p) {
        top[p] += coupling[p];
        low[p] += coupling[6 + p];
        for (Index v = 0; v < clocks; ++v) {
            const double by_clock = clock[p * clocks + v];
            top[6 + v] += coupling[p] * by_clock;
            low[6 + v] += coupling[6 + p] * by_clock;
        }
    }
}

// Writes corner c's block, from its observations' lower triangle (3,) and its survey, and its gradient (2,), at i.
inline void put_corner(
    const Layout& layout, Index c, Index i, const double* observed, const double* gradient, const Scratch& scratch) {
    const double* root = layout.control_root + 3 * c;
    double* block = scratch.block + i * scratch.block_columns + i;
    block[0] = observed[0] + root[0] * root[0] + root[1] * root[1];
    block[scratch.block_columns] = observed[1] + root[1] * root[2];
    block[scratch.block_columns + 1] = observed[2] + root[2] * root[2];
    scratch.gradient[i] = gradient[0];
    scratch.gradient[i + 1] = gradient[1];
}

}  // namespace
}  // namespace v2hdm::adjust
