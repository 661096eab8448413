// Passes where cameras alone move: all observations of a corner by a camera end in the same sums, so that they are
// taken side by side, several to a vector.
namespace v2hdm::adjust {
namespace {

constexpr int VECTOR = 4;   // numbers of a vector of AVX2
constexpr int BATCH = 32;   // most observations of a batch: a corner is seen so often by a camera, or less
using Lanes = double[BATCH];

inline bool cameras_alone_move(const Layout& layout, const Base& base) {
    return base.has_rows && base.width == 6 * (base.pairs / layout.moments);
}

// The observations of corner c from k on by the same camera, as many as a batch holds.
inline int batch_size(const Layout& layout, Index k, Index c) {
    const Index next = (layout.pair[k] / layout.moments + 1) * layout.moments;
    const Index most = std::min<Index>(layout.begin[c + 1] - k, BATCH);
    int count = 1;
    while (count < most && layout.pair[k + count] < next) ++count;
    return count;
}

inline double sum(const Lanes& a, int size) {
    double sums[VECTOR] = {};
    for (int begin = 0; begin < size; begin += VECTOR) {
        for (int l = 0; l < VECTOR; ++l) sums[l] += a[begin + l];
    }
    return (sums[0] + sums[1]) + (sums[2] + sums[3]);
}

// The sum of a b + c d.
inline double dots(const Lanes& a, const Lanes& b, const Lanes& c, const Lanes& d, int size) {
    double sums[VECTOR] = {};
    for (int begin = 0; begin < size; begin += VECTOR) {
        for (int l = 0; l < VECTOR; ++l) {
            sums[l] += a[begin + l] * b[begin + l] + c[begin + l] * d[begin + l];
        }
    }
    return (sums[0] + sums[1]) + (sums[2] + sums[3]);
}

// Adds a b + c d to sums by lane.
inline void add_dots(double* sums, const Lanes& a, const Lanes& b, const Lanes& c, const Lanes& d, int size) {
    double lanes[VECTOR];
    for (int l = 0; l < VECTOR; ++l) lanes[l] = sums[l];
    for (int begin = 0; begin < size; begin += VECTOR) {
        for (int l = 0; l < VECTOR; ++l) {
            lanes[l] += a[begin + l] * b[begin + l] + c[begin + l] * d[begin + l];
        }
    }
    for (int l = 0; l < VECTOR; ++l) sums[l] = lanes[l];
}

// Adds a to sums by lane.
inline void add_lanes(double* sums, const Lanes& a, int size) {
    double lanes[VECTOR];
    for (int l = 0; l < VECTOR; ++l) lanes[l] = sums[l];
    for (int begin = 0; begin < size; begin += VECTOR) {
        for (int l = 0; l < VECTOR; ++l) lanes[l] += a[begin + l];
    }
    for (int l = 0; l < VECTOR; ++l) sums[l] = lanes[l];
}

// Sums of a chunk by camera, some numbers each, whose lanes are added up at the end of the chunk: at the end of each
// batch that took as long as the batch. Without std::vector, whose code other files would share.
class CameraSums {
  public:
    CameraSums(Index cameras, int numbers) : numbers(numbers), lanes(new double[cameras * numbers * VECTOR]()) {}
    ~CameraSums() { delete[] lanes; }
    CameraSums(const CameraSums&) = delete;
    CameraSums& operator=(const CameraSums&) = delete;

    // By lane, number by number.
    double* of(Index camera) { return lanes + camera * numbers * VECTOR; }

    // Adds ``count`` numbers of a camera from ``first`` on to ``out``, and begins these anew.
    void flush(Index camera, int first, int count, double* out) {
        double* sums = of(camera) + first * VECTOR;
        for (int p = 0; p < count; ++p, sums += VECTOR) {
            out[p] += (sums[0] + sums[1]) + (sums[2] + sums[3]);
            std::fill_n(sums, VECTOR, 0.0);
        }
    }

    // Adds the wrenches, from number ``first`` on, to the first pair of each camera that the chunk touches.
    void flush_wrenches(const Layout& layout, Index q, int first, double* wrench) {
        Index last = -1;
        for (Index i = layout.touched_at[q]; i < layout.touched_at[q + 1]; ++i) {
            const Index camera = layout.touched[i] / layout.moments;
            if (camera != last) flush(camera, first, 6, wrench + 6 * i);
            last = camera;
        }
    }

  private:
    const int numbers;
    double* const lanes;
};

// Observations of the ground point x, y by a camera, as Seen. Lanes from ``count`` to ``size`` fill up the last
// vector: they repeat the last observation, at no weight.
struct Batch {
    int count, size;
    Lanes right[3], down[3], px, py, pz, inverse, slope, a, b, c, r0, r1, weight;

    Batch(const Layout& layout, const double* table, Index begin, int count, double x, double y)
        : count(count), size((count + VECTOR - 1) / VECTOR * VECTOR) {
        Lanes origin[3], u, v;
        for (int l = 0; l < size; ++l) {
            const Index k = begin + std::min(l, count - 1);
            const double* t = table + 16 * layout.pair[k];
            for (int i = 0; i < 3; ++i) {
                right[i][l] = t[4 * i];
                down[i][l] = t[4 * i + 1];
                origin[i][l] = t[4 * i + 3];
            }
            u[l] = layout.measured[k];
            v[l] = layout.measured[layout.observations + k];
            a[l] = layout.root[k];
            b[l] = layout.root[layout.observations + k];
            c[l] = layout.root[2 * layout.observations + k];
        }
        for (int l = 0; l < size; ++l) {
            px[l] = right[0][l] * x + down[0][l] * y + origin[0][l];
            py[l] = right[1][l] * x + down[1][l] * y + origin[1][l];
            pz[l] = right[2][l] * x + down[2][l] * y + origin[2][l];
            const double at_least = !(pz[l] < NEAR_M) ? pz[l] : NEAR_M;
            const double reciprocal = 1.0 / at_least;
            slope[l] = -reciprocal * reciprocal;
            inverse[l] = reciprocal + slope[l] * (pz[l] - at_least);
            const double off_u = px[l] * inverse[l] - u[l], off_v = py[l] * inverse[l] - v[l];
            r0[l] = a[l] * off_u;
            r1[l] = b[l] * off_u + c[l] * off_v;
        }
    }

    // Weights by the loss, which is added up.
    void weigh_all(const Base& base, LossSum& losses) {
        if (base.code == NONE) {
            for (int l = 0; l < size; ++l) weight[l] = l < count ? 1.0 : 0.0;
            Lanes squared;
            for (int l = 0; l < size; ++l) squared[l] = weight[l] * (r0[l] * r0[l] + r1[l] * r1[l]);
            losses.total += sum(squared, size);
            return;
        }
        for (int l = 0; l < count; ++l) {
            const double squared = r0[l] * r0[l] + r1[l] * r1[l];
            losses.add(base, squared);
            weight[l] = weigh(base, squared);
        }
        for (int l = count; l < size; ++l) weight[l] = 0.0;
    }
};

// Derivatives of a batch, as Derived, and residuals, both so that their products are those of the weighted ones: times
// the roots of the Hessian's weights, which are 0 in lanes that fill up.
struct BatchDerived {
    Lanes jacobian[16], r0, r1;

    explicit BatchDerived(const Batch& at) {
        Lanes *j = jacobian, root;
        for (int l = 0; l < at.size; ++l) {
            const double floor = std::sqrt(floored(at.weight[l]));
            const double weight = at.weight[l] / floor;
            root[l] = l < at.count ? floor : 0.0;
            r0[l] = l < at.count ? weight * at.r0[l] : 0.0;
            r1[l] = l < at.count ? weight * at.r1[l] : 0.0;
        }
        for (int l = 0; l < at.size; ++l) {
            const double a = at.a[l] * root[l], b = at.b[l] * root[l], c = at.c[l] * root[l], px = at.px[l], py = at.py[l], pz = at.pz[l];
            const double ad = a * at.inverse[l], bd = b * at.inverse[l], cd = c * at.inverse[l];
            const double g = a * px * at.slope[l], h = (b * px + c * py) * at.slope[l];
            j[0][l] = ad;
            j[1][l] = 0.0;
            j[2][l] = g;
            j[3][l] = py * g;
            j[4][l] = pz * ad - px * g;
            j[5][l] = -py * ad;
            j[6][l] = bd;
            j[7][l] = cd;
            j[8][l] = h;
            j[9][l] = py * h - pz * cd;
            j[10][l] = pz * bd - px * h;
            j[11][l] = px * cd - py * bd;
            j[12][l] = ad * at.right[0][l] + g * at.right[2][l];
            j[13][l] = ad * at.down[0][l] + g * at.down[2][l];
            j[14][l] = bd * at.right[0][l] + cd * at.right[1][l] + h * at.right[2][l];
            j[15][l] = bd * at.down[0][l] + cd * at.down[1][l] + h * at.down[2][l];
        }
    }
};

constexpr int SQUARES = 21;  // numbers of J'J by a camera's tangent, the first of its sums; then come its wrenches

// Adds a batch to the camera's sums and rows, and to the corner's block (3,) and gradient (2,).
void add_batch(const Batch& batch, double* sums, double* top, double* low, double* block, double* gradient) {
    const BatchDerived derived(batch);
    const Lanes* j = derived.jacobian;
    const int size = batch.size;
    for (int p = 0; p < 6; ++p) {
        for (int s = p; s < 6; ++s, sums += VECTOR) add_dots(sums, j[p], j[s], j[6 + p], j[6 + s], size);
    }
    for (int p = 0; p < 6; ++p) {
        top[p] += dots(j[12], j[p], j[14], j[6 + p], size);
        low[p] += dots(j[13], j[p], j[15], j[6 + p], size);
    }
    block[0] += dots(j[12], j[12], j[14], j[14], size);
    block[1] += dots(j[13], j[12], j[15], j[14], size);
    block[2] += dots(j[13], j[13], j[15], j[15], size);
    for (int p = 0; p < 6; ++p, sums += VECTOR) add_dots(sums, j[p], derived.r0, j[6 + p], derived.r1, size);
    gradient[0] += dots(j[12], derived.r0, j[14], derived.r1, size);
    gradient[1] += dots(j[13], derived.r0, j[15], derived.r1, size);
}

// add_corner where cameras alone move.
void add_corner_by_camera(
    const Layout& layout, const Base& base, Index c, Index first, const Scratch& scratch, CameraSums& sums,
    LossSum& losses) {
    const Index columns = scratch.row_columns, i = 2 * (c - first);
    const double x = base.corners[2 * c], y = base.corners[2 * c + 1];
    double block[3] = {}, gradient[2] = {};
    for (Index k = layout.begin[c]; k < layout.begin[c + 1];) {
        const Index camera = layout.pair[k] / layout.moments;
        Batch batch(layout, base.table, k, batch_size(layout, k, c), x, y);
        batch.weigh_all(base, losses);
        double *top = scratch.rows + i * columns + 6 * camera, *low = top + columns;
        add_batch(batch, sums.of(camera), top, low, block, gradient);
        k += batch.count;
    }
    put_corner(layout, c, i, block, gradient, scratch);
}

// see_corner where cameras alone move.
void see_corner_by_camera(
    const Layout& layout, const Base& base, const double* table, Index c, const Evaluation& out, CameraSums& sums,
    LossSum& losses, double* gradient) {
    gradient[0] = gradient[1] = 0;
    for (Index k = layout.begin[c]; k < layout.begin[c + 1];) {
        Batch batch(layout, table, k, batch_size(layout, k, c), out.corners[2 * c], out.corners[2 * c + 1]);
        batch.weigh_all(base, losses);
        const int size = batch.size;
        Lanes fx, fy, fz, turn[3], along[2];
        for (int l = 0; l < size; ++l) {
            const double r0 = batch.r0[l] * batch.weight[l], r1 = batch.r1[l] * batch.weight[l];
            const double fu = batch.a[l] * r0 + batch.b[l] * r1, fv = batch.c[l] * r1;
            const double px = batch.px[l], py = batch.py[l], pz = batch.pz[l];
            fx[l] = fu * batch.inverse[l];
            fy[l] = fv * batch.inverse[l];
            fz[l] = (fu * px + fv * py) * batch.slope[l];
            turn[0][l] = py * fz[l] - pz * fy[l];
            turn[1][l] = pz * fx[l] - px * fz[l];
            turn[2][l] = px * fy[l] - py * fx[l];
            along[0][l] = batch.right[0][l] * fx[l] + batch.right[1][l] * fy[l] + batch.right[2][l] * fz[l];
            along[1][l] = batch.down[0][l] * fx[l] + batch.down[1][l] * fy[l] + batch.down[2][l] * fz[l];
        }
        double* wrench = sums.of(layout.pair[k] / layout.moments);
        const Lanes* parts[6] = {&fx, &fy, &fz, &turn[0], &turn[1], &turn[2]};
        for (int p = 0; p < 6; ++p) add_lanes(wrench + VECTOR * p, *parts[p], size);
        gradient[0] += sum(along[0], size);
        gradient[1] += sum(along[1], size);
        k += batch.count;
    }
}

}  // namespace
}  // namespace v2hdm::adjust
