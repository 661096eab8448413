// Observations as the passes read them; twin of v2hdm.adjust.kernels.layout.lay_out.
namespace v2hdm::adjust {
namespace {

constexpr Index AHEAD = 48;  // observations ahead: about as long as memory takes

// Has an observation, of which the next is anywhere in memory, on its way.
void prefetch(const Columns& columns, Index k) {
#ifdef __GNUC__
    __builtin_prefetch(columns.pinhole_px + 2 * k);
    __builtin_prefetch(columns.covariance_px + 4 * k);
#else
    static_cast<void>(columns), static_cast<void>(k);
#endif
}

// Some observations: pixels from the principal point, focal lengths and the lower triangle of covariances.
struct LaidOut {
    Lanes u, v, fx, fy, xx, yx, yy;

    void read(const Columns& columns, const Sorted& sorted, Index begin, int count) {
        for (int l = 0; l < count; ++l) {
            prefetch(columns, sorted.order[std::min(begin + l + AHEAD, columns.count - 1)]);
            const Index k = sorted.order[begin + l];
            const double* intrinsic = columns.intrinsic + 4 * (sorted.pair[begin + l] / sorted.frames);
            const double* covariance = columns.covariance_px + 4 * k;
            fx[l] = intrinsic[0];
            fy[l] = intrinsic[1];
            u[l] = columns.pinhole_px[2 * k] - intrinsic[2];
            v[l] = columns.pinhole_px[2 * k + 1] - intrinsic[3];
            xx[l] = covariance[0];
            yx[l] = covariance[2];
            yy[l] = covariance[3];
        }
    }

    // Number of observations of lines, whose squared traces exceed their determinants so much.
    int lines(int count, double line_excess) const {
        int lines = 0;
        for (int l = 0; l < count; ++l) {
            const double trace = xx[l] + yy[l], determinant = xx[l] * yy[l] - yx[l] * yx[l];
            lines += trace * trace > determinant * line_excess;
        }
        return lines;
    }

    // Writes numbers of so many observations to rows of ``stride``.
    void write(int count, Index stride, double* measured, double* root) const {
        for (int l = 0; l < count; ++l) {
            measured[l] = u[l] / fx[l];
            measured[stride + l] = v[l] / fy[l];
            const double over_first = 1 / std::sqrt(xx[l]), below = yx[l] * over_first;
            const double over_last = 1 / std::sqrt(yy[l] - below * below);
            root[l] = fx[l] * over_first;
            root[stride + l] = -below * fx[l] * over_first * over_last;
            root[2 * stride + l] = fy[l] * over_last;
        }
    }
};

Index lay_out(const Columns& columns, const Sorted& sorted, double line_excess, double* measured, double* root) {
    Index lines = 0;
    LaidOut some;
    for (Index begin = 0; begin < columns.count; begin += BATCH) {
        const int count = static_cast<int>(std::min<Index>(columns.count - begin, BATCH));
        some.read(columns, sorted, begin, count);
        some.write(count, columns.count, measured + begin, root + begin);
        lines += some.lines(count, line_excess);
    }
    return lines;
}

}  // namespace
}  // namespace v2hdm::adjust
