// Back-projection; twin of v2hdm.adjust.kernels.evaluate.meet_ground.
namespace v2hdm::adjust {
namespace {

// Information of a corner's rays on it, and the same times the ground points.
struct GroundSums {
    double xx = 0, yx = 0, yy = 0, x = 0, y = 0;
};

// Rays of observations, several to a vector: homographies of their pairs, and what was measured.
struct Rays {
    int count, size;
    Lanes ground[9], u, v, a, b, c;

    Rays(const Layout& layout, const double* homographies, Index begin, int count)
        : count(count), size((count + VECTOR - 1) / VECTOR * VECTOR) {
        for (int l = 0; l < size; ++l) {
            const Index k = begin + std::min(l, count - 1);
            const double* homography = homographies + 9 * layout.pair[k];
            for (int i = 0; i < 9; ++i) ground[i][l] = homography[i];
            u[l] = layout.measured[k];
            v[l] = layout.measured[layout.observations + k];
            a[l] = layout.root[k];
            b[l] = layout.root[layout.observations + k];
            c[l] = layout.root[2 * layout.observations + k];
        }
    }

    // Adds the rays that are not too flat.
    void add(GroundSums& sums) const {
        Lanes xx, yx, yy, x, y;
        const Lanes* h = ground;
        for (int l = 0; l < size; ++l) {
            const double drop = h[6][l] * u[l] + h[7][l] * v[l] + h[8][l];
            const double least = MIN_DEPRESSION_SINE * MIN_DEPRESSION_SINE * (1 + u[l] * u[l] + v[l] * v[l]);
            const bool is_met = (l < count) & (drop > 0) & (drop * drop > least);
            const double reciprocal = 1 / drop;
            const double east = (h[0][l] * u[l] + h[1][l] * v[l] + h[2][l]) * reciprocal;
            const double north = (h[3][l] * u[l] + h[4][l] * v[l] + h[5][l]) * reciprocal;
            const double xu = h[0][l] - east * h[6][l], xv = h[1][l] - east * h[7][l];
            const double yu = h[3][l] - north * h[6][l], yv = h[4][l] - north * h[7][l];
            const double share = drop / (xu * yv - xv * yu);
            const double j0 = a[l] * share * yv, j2 = b[l] * share * yv - c[l] * share * yu;
            const double j1 = -a[l] * share * xv, j3 = -b[l] * share * xv + c[l] * share * xu;
            xx[l] = is_met ? j0 * j0 + j2 * j2 : 0.0;
            yx[l] = is_met ? j0 * j1 + j2 * j3 : 0.0;
            yy[l] = is_met ? j1 * j1 + j3 * j3 : 0.0;
            x[l] = is_met ? xx[l] * east + yx[l] * north : 0.0;
            y[l] = is_met ? yx[l] * east + yy[l] * north : 0.0;
        }
        sums.xx += sum(xx, size);
        sums.yx += sum(yx, size);
        sums.yy += sum(yy, size);
        sums.x += sum(x, size);
        sums.y += sum(y, size);
    }
};

void meet_ground(
    Index begin, Index end, const Layout& layout, const double* homographies, double* corners, bool* determined) {
    for (Index c = first_corner(layout, begin); c < first_corner(layout, end); ++c) {
        GroundSums sums;
        for (Index k = layout.begin[c]; k < layout.begin[c + 1]; k += BATCH) {
            const int count = static_cast<int>(std::min<Index>(layout.begin[c + 1] - k, BATCH));
            Rays(layout, homographies, k, count).add(sums);
        }
        determined[c] = sums.xx > 0;
        corners[2 * c] = corners[2 * c + 1] = 0.0;
        if (!(sums.xx > 0)) continue;
        const double first = std::sqrt(sums.xx), below = sums.yx / first;
        const double remainder = sums.yy - below * below, least = PIVOT_FLOOR * sums.yy;
        const double last = std::sqrt(remainder < least ? least : remainder);
        const double top = sums.x / first, low = (sums.y - below * top) / last / last;
        corners[2 * c] = (top - below * low) / first;
        corners[2 * c + 1] = low;
    }
}

}  // namespace
}  // namespace v2hdm::adjust
