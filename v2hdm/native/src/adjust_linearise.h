// Linearisation; twin of v2hdm.adjust.kernels.linearise.
namespace v2hdm::adjust {
namespace {

// Adds the observations of corner c to gradients, blocks, rows and loss; its unit begins at ``first``.
void add_corner(
    const Layout& layout, const Base& base, const double* clock, Index c, Index first, const Scratch& scratch,
    const Linearisation& out, LossSum& losses) {
    const Index cameras = base.pairs / layout.moments, unknowns = out.width / cameras;
    const Index i = 2 * (c - first), columns = scratch.row_columns;
    double *top = scratch.rows + i * columns, *low = top + columns;
    const double x = base.corners[2 * c], y = base.corners[2 * c + 1];
    double block[3] = {}, gradient[2] = {};
    for (Index k = layout.begin[c]; k < layout.begin[c + 1]; ++k) {
        const Derived derived(layout, base.table, k, x, y);
        const double* j = derived.jacobian;
        losses.add(base, derived.squared());
        double weight = weigh(base, derived.squared());
        const double w0 = weight * derived.r0, w1 = weight * derived.r1;
        gradient[0] += j[12] * w0 + j[14] * w1;
        gradient[1] += j[13] * w0 + j[15] * w1;
        const int32_t pair = layout.pair[k], at = scratch.slot[pair];
        const Index camera = pair / layout.moments;
        add_force(
            out.wrench + 6 * at, derived.px, derived.py, derived.pz, j[0] * w0 + j[6] * w1, j[7] * w1,
            j[2] * w0 + j[8] * w1);
        weight = floored(weight);
        block[0] += weight * (j[12] * j[12] + j[14] * j[14]);
        block[1] += weight * (j[13] * j[12] + j[15] * j[14]);
        block[2] += weight * (j[13] * j[13] + j[15] * j[15]);
        derived.add_square(weight, out.squares + 21 * at);
        double* coupling = scratch.coupling + (base.has_rows ? 0 : 12 * (k - layout.begin[first]));
        derived.couple(weight, coupling);
        const Index column = camera * unknowns;
        add_camera(coupling, clock + pair * 6 * (unknowns - 6), unknowns, top + column, low + column);
    }
    put_corner(layout, c, i, block, gradient, scratch);
}

// Adds W times unit u's gradient to the pairs that see it.
void carry_back(const Layout& layout, Index u, const Scratch& scratch, double* coupled) {
    const Index first = layout.unit[u];
    for (Index c = first; c < layout.unit[u + 1]; ++c) {
        const double *gradient = scratch.gradient + 2 * (c - first), x = gradient[0], y = gradient[1];
        for (Index k = layout.begin[c]; k < layout.begin[c + 1]; ++k) {
            double* sum = coupled + 6 * scratch.slot[layout.pair[k]];
            const double* coupling = scratch.coupling + 12 * (k - layout.begin[first]);
            for (int p = 0; p < 6; ++p) sum[p] += coupling[p] * x + coupling[6 + p] * y;
        }
    }
}

// Adds B'B of ``count`` rows to the lower triangle of the tip (width, width).
void add_products(const Scratch& scratch, Index count, double* tip, Index width) {
    for (Index i = 0; i < count; i += 2) {
        const double *row = scratch.rows + i * scratch.row_columns, *next = row + scratch.row_columns;
        for (Index p = 0; p < width; ++p) {
            const double top = row[p], low = next[p];
            double* sum = tip + p * width;
            for (Index s = 0; s <= p; ++s) sum[s] += top * row[s] + low * next[s];
        }
    }
}

// Adds J'J of a unit's known lengths to the lower triangle of its block.
void add_lengths(const Layout& layout, Index u, const double* corners, const Scratch& scratch) {
    const Index first = layout.unit[u], columns = scratch.block_columns;
    for (Index m = layout.length_at[u]; m < layout.length_at[u + 1]; ++m) {
        const LengthResidual length = length_residual(layout, m, corners);
        const double xx = length.jx * length.jx, xy = length.jx * length.jy, yy = length.jy * length.jy;
        const Index a = 2 * (layout.length_first[m] - first), b = 2 * (layout.length_second[m] - first);
        for (const Index at : {a, b}) {
            double* block = scratch.block + at * columns + at;
            block[0] += xx;
            block[columns] += xy;
            block[columns + 1] += yy;
        }
        double* block = scratch.block + std::max(a, b) * columns + std::min(a, b);
        block[0] -= xx;
        block[1] -= xy;
        block[columns] -= xy;
        block[columns + 1] -= yy;
    }
}

// Eliminates a unit whose block, gradient and rows are complete.
void eliminate_unit(
    const Layout& layout, const Base& base, Index q, Index u, const Scratch& scratch, const Linearisation& out) {
    const auto [n, c, at] = unit_of(layout, u);
    const Index width = out.width;
    if (layout.is_kept[u]) {
        keep_unit(layout, base, u, scratch);
        std::copy(scratch.gradient, scratch.gradient + n, out.whitened + 2 * c);
        return;
    }
    if (!factorise_unit(layout, base, u, scratch)) {
        out.failed[q] += 1.0;
        return;
    }
    solve_unit(layout, base, u, scratch.gradient);
    solve_unit_rows(layout, base, u, scratch, 0, width);
    for (Index i = 0; i < n; ++i) {
        const double gradient = scratch.gradient[i], *row = scratch.rows + i * scratch.row_columns;
        out.whitened[2 * c + i] = gradient;
        if (!base.has_rows) continue;
        std::copy(row, row + width, base.rows + (2 * c + i) * width);
        double* carried = out.carried + q * width;
        for (Index p = 0; p < width; ++p) carried[p] += row[p] * gradient;
    }
    if (!base.has_rows) {
        solve_unit_transposed(layout, base, u, scratch.gradient);
        carry_back(layout, u, scratch, out.coupled);
    }
    add_products(scratch, n, out.tip + q * width * width, width);
}

void linearise(
    Index begin, Index end, const Layout& layout, const Base& base, const double* clock, bool by_pair,
    const Scratch& scratch, const Linearisation& out) {
    const Index cameras = base.pairs / layout.moments;
    CameraSums sums(cameras, SQUARES + 6);
    for (Index q = begin; q < end; ++q) {
        number_touched(layout, q, scratch.slot);
        LossSum losses;
        for (Index u = layout.chunk[q]; u < layout.chunk[q + 1]; ++u) {
            const Index first = layout.unit[u], n = unit_of(layout, u).n;
            for (Index i = 0; i < n; ++i) {
                std::fill_n(scratch.block + i * scratch.block_columns, n, 0.0);
                std::fill_n(scratch.rows + i * scratch.row_columns, out.width, 0.0);
            }
            for (Index c = first; c < layout.unit[u + 1]; ++c) {
                if (by_pair) {
                    add_corner(layout, base, clock, c, first, scratch, out, losses);
                } else {
                    add_corner_by_camera(layout, base, c, first, scratch, sums, losses);
                }
            }
            add_corner_priors(layout, u, base.corners, scratch.gradient, out.costs + 3 * q);
            add_lengths(layout, u, base.corners, scratch);
            eliminate_unit(layout, base, q, u, scratch, out);
        }
        if (!by_pair) {
            for (Index c = 0; c < cameras; ++c) sums.flush(c, 0, SQUARES, out.squares + SQUARES * (q * cameras + c));
            sums.flush_wrenches(layout, q, SQUARES, out.wrench);
        }
        out.costs[3 * q] = losses.cost(base);
    }
}

// The tiles of a unit in elimination order; rows of ``marks``, by tile.
struct Marks {
    Index *mark, *place, *touched, *low, *high;

    Marks(Index* marks, Index columns)
        : mark(marks), place(marks + columns), touched(marks + 2 * columns), low(marks + 3 * columns),
          high(marks + 4 * columns) {}

    // Lists the tiles of unit u; returns their number.
    Index touch(const Layout& layout, Index u, const TileMap& tiles) {
        Index count = 0;
        for (Index k = layout.begin[layout.unit[u]]; k < layout.begin[layout.unit[u + 1]]; ++k) {
            const Index tile = layout.frame[layout.pair[k] % layout.moments] / tiles.per_tile;
            if (mark[tile] == u) continue;
            mark[tile] = u;
            touched[count++] = tile;
        }
        std::sort(touched, touched + count, [&](Index a, Index b) { return tiles.position[a] < tiles.position[b]; });
        for (Index a = 0; a < count; ++a) place[touched[a]] = a;
        return count;
    }

    bool reaches(Index begin, Index end, const TileMap& tiles, Index count) const {
        return std::any_of(touched, touched + count, [&](Index tile) {
            return begin <= tiles.position[tile] && tiles.position[tile] < end;
        });
    }
};

// Subtracts B'B of a unit's n rows in columns ``begin`` to ``end`` of its ``count`` tiles.
void subtract_products(
    Index begin, Index end, const TileMap& tiles, const Marks& marks, Index count, const Scratch& scratch, Index n,
    double* values) {
    const Index size = tiles.size;
    for (Index a = 0; a < count; ++a) {
        const Index column = tiles.position[marks.touched[a]];
        if (!(begin <= column && column < end)) continue;
        const Index low = marks.low[a];
        for (Index b = a; b <= count; ++b) {
            const Index row = b == count ? tiles.tiles : tiles.position[marks.touched[b]];
            Index tile = tiles.begin[column];
            while (tiles.row[tile] != row) ++tile;
            for (Index i = 0; i < n; i += 2) {
                const double *first = scratch.rows + i * scratch.row_columns, *second = first + scratch.row_columns;
                for (Index r = marks.low[b]; r < marks.high[b]; ++r) {
                    const double x = first[b * size + r], y = second[b * size + r];
                    if (x == 0.0 && y == 0.0) continue;
                    // Diagonal tiles are lower triangular.
                    const Index stop = a == b ? r + 1 : marks.high[a];
                    double* out = values + tiles.at[tile] + r * size;
                    const double *top = first + a * size, *bottom = second + a * size;
                    for (Index s = low; s < stop; ++s) out[s] -= x * top[s] + y * bottom[s];
                }
            }
        }
    }
}

// Writes a unit's rows by tiles and tip, and which columns of each are not zero.
void fill_rows(
    const Layout& layout, const Base& base, const TileMap& tiles, const FrameJacobians& by, Index u, Index count,
    Marks& marks, const Scratch& scratch) {
    const Index states = by.states, unknowns = by.unknowns, size = tiles.size, tip = count * size;
    const Index first = layout.unit[u], columns = scratch.row_columns;
    double w[12];
    for (Index c = first; c < layout.unit[u + 1]; ++c) {
        double *top = scratch.rows + 2 * (c - first) * columns, *low = top + columns;
        for (Index k = layout.begin[c]; k < layout.begin[c + 1]; ++k) {
            const Derived derived(layout, base.table, k, base.corners[2 * c], base.corners[2 * c + 1]);
            derived.couple(floored(weigh(base, derived.squared())), w);
            const Index t = layout.pair[k], frame = layout.frame[t % layout.moments];
            const Index a = marks.place[frame / tiles.per_tile], within = frame % tiles.per_tile * states;
            marks.low[a] = std::min(marks.low[a], within);
            marks.high[a] = std::max(marks.high[a], within + states);
            const Index column = a * size + within;
            const double* by_state = by.by_state + t * 6 * states;
            for (int p = 0; p < 6; ++p) {
                for (Index s = 0; s < states; ++s) {
                    top[column + s] += w[p] * by_state[p * states + s];
                    low[column + s] += w[6 + p] * by_state[p * states + s];
                }
            }
            const Index camera = tip + t / layout.moments * unknowns;
            add_camera(w, by.clock + t * 6 * (unknowns - 6), unknowns, top + camera, low + camera);
        }
    }
}

void subtract_frames(
    Index begin, Index end, const Layout& layout, const Base& base, const TileMap& tiles, const FrameJacobians& by,
    Index* room, const Scratch& scratch, double* values) {
    const Index width = base.pairs / layout.moments * by.unknowns, size = tiles.size;
    Marks marks(room, tiles.tiles + 1);
    for (Index u = 0; u < layout.units; ++u) {
        if (layout.is_kept[u]) continue;
        const Index count = marks.touch(layout, u, tiles);
        if (!marks.reaches(begin, end, tiles, count)) continue;
        std::fill_n(marks.low, count, size);
        std::fill_n(marks.high, count, 0);
        marks.low[count] = 0;
        marks.high[count] = width;
        const Index n = unit_of(layout, u).n;
        for (Index i = 0; i < n; ++i) std::fill_n(scratch.rows + i * scratch.row_columns, count * size + width, 0.0);
        fill_rows(layout, base, tiles, by, u, count, marks, scratch);
        for (Index a = 0; a <= count; ++a) {
            solve_unit_rows(layout, base, u, scratch, a * size + marks.low[a], a * size + marks.high[a]);
        }
        subtract_products(begin, end, tiles, marks, count, scratch, n, values);
    }
}

}  // namespace
}  // namespace v2hdm::adjust
