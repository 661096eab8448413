// Evaluation, back-projection and report; twin of v2hdm.adjust.kernels.evaluate.
namespace v2hdm::adjust {
namespace {

// A linearised observation, a row of Scratch.observed: point, inverse depth, slope, information at depth 1.
struct Observed {
    double px, py, pz, inverse, slope, uu, uv, vv;

    // Force with which it opposes a motion of its point.
    void oppose(double mx, double my, double mz, double& fx, double& fy, double& fz) const {
        const double along = slope * mz;
        const double x = mx * inverse + px * along, y = my * inverse + py * along;
        const double fu = uu * x + uv * y, fv = uv * x + vv * y;
        fx = fu * inverse;
        fy = fv * inverse;
        fz = (fu * px + fv * py) * slope;
    }
};

Observed recall(const Layout& layout, const Base& base, Index k, Index c) {
    const Seen seen = see(layout, base.table, k, base.corners[2 * c], base.corners[2 * c + 1]);
    const auto [a, b, d] = root_of(layout, k);
    double weight = 1.0;
    if (base.code != NONE) {
        const double r0 = a * seen.u, r1 = b * seen.u + d * seen.v;
        weight = floored(weigh(base, r0 * r0 + r1 * r1));
    }
    return {
        seen.px, seen.py, seen.pz, seen.inverse, seen.slope, (a * a + b * b) * weight, b * d * weight, d * d * weight};
}

Observed* observed_of(const Scratch& scratch) { return reinterpret_cast<Observed*>(scratch.observed); }

// Whitens the gradient of unit u of chunk q, and adds W V^-1 g to the pairs' or to the cameras'.
void carry_unit(
    const Layout& layout, const Base& base, Index q, Index u, bool coupled, const Scratch& scratch,
    const Evaluation& out) {
    double* gradient = scratch.gradient;
    const Index first = layout.unit[u], last = layout.unit[u + 1];
    solve_unit(layout, base, u, gradient);
    for (Index i = 0; i < 2 * (last - first); ++i) {
        out.whitened[2 * first + i] = gradient[i];
        if (!base.has_rows) continue;
        const double* row = base.rows + (2 * first + i) * base.width;
        double* carried = out.carried + q * base.width;
        for (Index p = 0; p < base.width; ++p) carried[p] += row[p] * gradient[i];
    }
    if (!coupled) return;
    solve_unit_transposed(layout, base, u, gradient);
    for (Index c = first; c < last; ++c) {
        const double x = gradient[2 * (c - first)], y = gradient[2 * (c - first) + 1];
        for (Index k = layout.begin[c]; k < layout.begin[c + 1]; ++k) {
            const Observed& observed = observed_of(scratch)[k - layout.begin[first]];
            const double* t = base.table + 16 * layout.pair[k];
            double fx, fy, fz;
            observed.oppose(t[0] * x + t[1] * y, t[4] * x + t[5] * y, t[8] * x + t[9] * y, fx, fy, fz);
            double* sum = out.coupled + 6 * scratch.slot[layout.pair[k]];
            add_force(sum, observed.px, observed.py, observed.pz, fx, fy, fz);
        }
    }
}

void carry(
    Index begin, Index end, const Layout& layout, const Base& base, const double* by_corner, const Scratch& scratch,
    const Evaluation& out) {
    for (Index q = begin; q < end; ++q) {
        number_touched(layout, q, scratch.slot);
        for (Index u = layout.chunk[q]; u < layout.chunk[q + 1]; ++u) {
            const Index first = layout.unit[u], last = layout.unit[u + 1];
            const bool coupled = !base.has_rows && !layout.is_kept[u];
            std::copy(by_corner + 2 * first, by_corner + 2 * last, scratch.gradient);
            for (Index c = first; coupled && c < last; ++c) {
                for (Index k = layout.begin[c]; k < layout.begin[c + 1]; ++k) {
                    observed_of(scratch)[k - layout.begin[first]] = recall(layout, base, k, c);
                }
            }
            carry_unit(layout, base, q, u, coupled, scratch, out);
        }
    }
}

// Unwhitened push (2,) of a step of cameras and frames on corner c; its unit begins at ``first``.
void push_corner(
    const Layout& layout, const Base& base, Index c, Index first, bool coupled, const Step& step,
    const Scratch& scratch, double* push) {
    double sx = 0, sy = 0;
    if (base.has_rows) {
        const double *top = base.rows + 2 * c * base.width, *low = top + base.width;
        for (Index p = 0; p < base.width; ++p) {
            sx += top[p] * step.cameras[p];
            sy += low[p] * step.cameras[p];
        }
    }
    for (Index k = layout.begin[c]; coupled && k < layout.begin[c + 1]; ++k) {
        const Observed observed = recall(layout, base, k, c);
        observed_of(scratch)[k - layout.begin[first]] = observed;
        const double *m = step.motion + 6 * layout.pair[k], *t = base.table + 16 * layout.pair[k];
        double fx, fy, fz, ax, ay;
        observed.oppose(
            m[0] + m[4] * observed.pz - m[5] * observed.py, m[1] + m[5] * observed.px - m[3] * observed.pz,
            m[2] + m[3] * observed.py - m[4] * observed.px, fx, fy, fz);
        along_axes(t, fx, fy, fz, ax, ay);
        sx += ax;
        sy += ay;
    }
    push[0] = sx;
    push[1] = sy;
}

// Gradient (2,) at corner c's new position; adds to the loss and to the pairs' gradients.
void see_corner(
    const Layout& layout, const Base& base, const double* table, Index c, const Scratch& scratch,
    const Evaluation& out, LossSum& losses, double* gradient) {
    double gx = 0, gy = 0;
    const double x = out.corners[2 * c], y = out.corners[2 * c + 1];
    for (Index k = layout.begin[c]; k < layout.begin[c + 1]; ++k) {
        const Seen seen = see(layout, table, k, x, y);
        const auto [a, b, d] = root_of(layout, k);
        const double r0 = a * seen.u, r1 = b * seen.u + d * seen.v;
        const double squared = r0 * r0 + r1 * r1;
        losses.add(base, squared);
        const double weight = weigh(base, squared);
        const double fu = (a * r0 + b * r1) * weight, fv = d * r1 * weight;
        const double fx = fu * seen.inverse, fy = fv * seen.inverse;
        const double fz = (fu * seen.px + fv * seen.py) * seen.slope;
        double ax, ay;
        along_axes(table + 16 * layout.pair[k], fx, fy, fz, ax, ay);
        gx += ax;
        gy += ay;
        add_force(out.wrench + 6 * scratch.slot[layout.pair[k]], seen.px, seen.py, seen.pz, fx, fy, fz);
    }
    gradient[0] = gx;
    gradient[1] = gy;
}

void evaluate(
    Index begin, Index end, const Layout& layout, const Base& base, const Step& by, const Scratch& scratch,
    const Evaluation& out) {
    double *step = scratch.step, *gradient = scratch.gradient;
    const bool is_by_camera = cameras_alone_move(layout, base);
    CameraSums sums(base.pairs / layout.moments, 6);
    for (Index q = begin; q < end; ++q) {
        number_touched(layout, q, scratch.slot);
        LossSum losses;
        for (Index u = layout.chunk[q]; u < layout.chunk[q + 1]; ++u) {
            const Index first = layout.unit[u], last = layout.unit[u + 1];
            const bool coupled = !base.has_rows && !layout.is_kept[u];
            for (Index c = first; c < last; ++c) {
                push_corner(layout, base, c, first, coupled, by, scratch, step + 2 * (c - first));
            }
            if (coupled) solve_unit(layout, base, u, step);
            for (Index i = 0; i < 2 * (last - first); ++i) step[i] = by.whitened[2 * first + i] - step[i];
            solve_unit_transposed(layout, base, u, step);
            for (Index c = first; c < last; ++c) {
                const Index i = 2 * (c - first);
                out.corners[2 * c] = base.corners[2 * c] + step[i];
                out.corners[2 * c + 1] = base.corners[2 * c + 1] + step[i + 1];
                if (is_by_camera) {
                    see_corner_by_camera(layout, base, by.table, c, out, sums, losses, gradient + i);
                } else {
                    see_corner(layout, base, by.table, c, scratch, out, losses, gradient + i);
                }
            }
            add_corner_priors(layout, u, out.corners, gradient, out.costs + 3 * q);
            carry_unit(layout, base, q, u, coupled, scratch, out);
        }
        if (is_by_camera) sums.flush_wrenches(layout, q, 0, out.wrench);
        out.costs[3 * q] = losses.cost(base);
    }
}

constexpr Index ROWS_AHEAD = 48;  // observations ahead: about as long as memory takes

// Has the places of an observation in a report, of which the next is anywhere in memory, on their way.
void prefetch_rows(const Report& out, Index row) {
#ifdef __GNUC__
    __builtin_prefetch(out.residual_px + 2 * row, 1);
    __builtin_prefetch(out.mahalanobis2 + row, 1);
#else
    static_cast<void>(out), static_cast<void>(row);
#endif
}

void report(
    Index begin, Index end, const Layout& layout, const double* table, const double* corners, const int32_t* order,
    const double* focal, const Report& out) {
    for (Index c = first_corner(layout, begin); c < first_corner(layout, end); ++c) {
        for (Index k = layout.begin[c]; k < layout.begin[c + 1]; ++k) {
            const Seen seen = see(layout, table, k, corners[2 * c], corners[2 * c + 1]);
            const auto [a, b, d] = root_of(layout, k);
            const double r0 = a * seen.u, r1 = b * seen.u + d * seen.v;
            const Index row = order[k], camera = layout.pair[k] / layout.moments;
            prefetch_rows(out, order[std::min(k + ROWS_AHEAD, layout.observations - 1)]);
            out.residual_px[2 * row] = seen.u * focal[2 * camera];
            out.residual_px[2 * row + 1] = seen.v * focal[2 * camera + 1];
            out.mahalanobis2[row] = r0 * r0 + r1 * r1;
            out.behind[row] = seen.pz <= NEAR_M;
        }
    }
}

void residuals(
    Index begin, Index end, const Layout& layout, const double* table, const double* corners, double* out) {
    for (Index c = first_corner(layout, begin); c < first_corner(layout, end); ++c) {
        for (Index k = layout.begin[c]; k < layout.begin[c + 1]; ++k) {
            const Seen seen = see(layout, table, k, corners[2 * c], corners[2 * c + 1]);
            const auto [a, b, d] = root_of(layout, k);
            out[k] = a * seen.u;
            out[layout.observations + k] = b * seen.u + d * seen.v;
        }
    }
}

void pull(
    const Layout& layout, const double* table, const double* corners, const double* by_residual, double* wrench,
    double* by_corner) {
    for (Index c = 0; c < layout.corners; ++c) {
        for (Index k = layout.begin[c]; k < layout.begin[c + 1]; ++k) {
            const Derived derived(layout, table, k, corners[2 * c], corners[2 * c + 1]);
            const double* j = derived.jacobian;
            const double r0 = by_residual[k], r1 = by_residual[layout.observations + k];
            by_corner[2 * c] += j[12] * r0 + j[14] * r1;
            by_corner[2 * c + 1] += j[13] * r0 + j[15] * r1;
            double* sum = wrench + 6 * layout.pair[k];
            for (int p = 0; p < 6; ++p) sum[p] += j[p] * r0 + j[6 + p] * r1;
        }
    }
}

void couplings(const Layout& layout, const Base& base, const Index* corner, Index count, double* out) {
    for (Index k = 0; k < count; ++k) {
        const double* at = base.corners + 2 * corner[k];
        const Derived derived(layout, base.table, k, at[0], at[1]);
        derived.couple(floored(weigh(base, derived.squared())), out + 12 * k);
    }
}

}  // namespace
}  // namespace v2hdm::adjust
