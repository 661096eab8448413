// The steps, for the processor that the file which includes this is compiled for, as V2HDM_SETTLE.
namespace v2hdm {
namespace {

constexpr int BLOCK = 16;         // pixels that are worked on together; a row of a buffer is padded to these
constexpr int LANES = 8;          // sums that are taken side by side
constexpr int BINS = 64;          // places along a marking that pixels are put in order by
constexpr int MEDIAN_STRIDE = 3;  // lattice.py: a median is taken over every third value
constexpr float FAR_BLURS = 5.0f; // blurs from a side beyond which it changes nothing: its density is 1.5e-6
constexpr float LOG_SQRT_2PI = 0.91893853f;
constexpr int32_t NOWHERE = -1;   // the place of a pixel that is not used

using Matrix = double[UNKNOWNS][UNKNOWNS];
using Vector = double[UNKNOWNS];

struct Pair {
    int32_t first, second;
};

float normal_pdf(float x) { return exponential(-0.5f * x * x - LOG_SQRT_2PI); }

// Share of the standard normal between 0 and x; coverage.py names the source.
float normal_share(float x) {
    const float odds = 2.0f * x * (0.7988f + 0.03528f * x * x);
    return 0.5f - 1.0f / (exponential(odds) + 1.0f);
}

// Factor by which variance grows if residuals correlate with their neighbours; robust.variance_inflation.
struct Correlation {
    float power = 0.0f, product = 0.0f;

    double inflation(double most_correlation) const {
        const double correlation = product / std::max(power / 2.0, 1e-12);
        const double r = std::clamp(correlation, 0.0, most_correlation);
        return (1 + r) / (1 - r);
    }
};

// A marking's pixels and what is computed of them, in rows of equal length.
class Fit {
  public:
    Fit(const Pixels& pixels, const OwenTable& table, const FitRules& rules)
        : pixels_(pixels), table_(table), rules_(rules) {
        arrange();
        row_ = (count_ + BLOCK - 1) / BLOCK * BLOCK;
        buffer_.assign(static_cast<size_t>(row_) * ROWS, 0.0f);
        copy(pixels.points, X);
        copy(pixels.points + pixels.stride, Y);
        copy(pixels.values, VALUES);
        copy(pixels.use, USE);
        copy(pixels.across, ACROSS);
        for (int s = 0; s < SIDES; ++s) copy(pixels.of_side + s * pixels.stride, OF_SIDE + s);
        for (int k = 0; k < KNOTS; ++k) copy(pixels.hats + k * pixels.stride, HATS + k);
        if (pixels.paint != nullptr) copy(pixels.paint, PAINT);
        near_.resize(row_ / BLOCK);
        lit_.assign(row_ / BLOCK, 0);
        for (int i = 0; i < row_; ++i) {
            for (int k = 0; k < KNOTS; ++k) lit_[i / BLOCK] |= (row(HATS + k)[i] != 0.0f) << k;
        }
    }

    void step(Unknowns& unknowns, double least_scatter, Equations& equations) {
        const Quad quad(unknowns.corners);
        cover(quad, *unknowns.blur_px);
        if (std::isnan(unknowns.light[0])) first_light(unknowns);
        explain(unknowns);
        weigh(least_scatter, equations);
        Matrix information;
        Vector gradient;
        square(*unknowns.contrast, information, gradient);
        add_priors(quad, unknowns, information, gradient);
        Vector step;
        std::copy(gradient, gradient + UNKNOWNS, step);
        solve_symmetric(information, step);
        move(quad, step, unknowns, equations);
        *equations.decrement = 0.0;
        for (int u = 0; u < UNKNOWNS; ++u) *equations.decrement += gradient[u] * step[u];
        for (int u = 0; u < UNKNOWNS; ++u) {
            std::copy(information[u], information[u] + UNKNOWNS, equations.information + u * UNKNOWNS);
        }
    }

  private:
    // Rows of the buffer.
    enum Row {
        X, Y, VALUES, USE, ACROSS, PAINT,
        OF_SIDE,
        HATS = OF_SIDE + SIDES,
        COVERAGE = HATS + KNOTS,
        BY_SHAPE,  // the coverage's derivatives by the sides' starts and ends, and by the blur
        RESIDUAL = BY_SHAPE + BLUR + 1,
        USED, ROBUST, WEIGHT, RATIO, WEIGHTED, SCRATCH,
        ROWS
    };

    float* row(int number) { return buffer_.data() + static_cast<size_t>(number) * row_; }

    void copy(const float* from, int number) {
        float* to = row(number);
        for (int i = 0; i < count_; ++i) to[i] = from[order_[i]];
    }

    // Put the pixels that are used in order of their sides, and along the marking: near most blocks of them there
    // are one side and few knots.
    void arrange() {
        std::vector<float> along(pixels_.count, 0.0f);  // in knots
        for (int k = 1; k < KNOTS; ++k) {
            const float* hat = pixels_.hats + static_cast<int64_t>(k) * pixels_.stride;
            for (int i = 0; i < pixels_.count; ++i) along[i] += k * hat[i];
        }
        constexpr float PER_KNOT = static_cast<float>(BINS) / (KNOTS - 1);
        int32_t ends[(SIDES + 1) * BINS + 1] = {};
        std::vector<int32_t> bin(pixels_.count, NOWHERE);
        for (int i = 0; i < pixels_.count; ++i) {
            if (pixels_.use[i] == 0.0f) continue;
            int side = 0;
            while (side < SIDES && !(pixels_.of_side[side * pixels_.stride + i] > 0)) ++side;
            bin[i] = side * BINS + static_cast<int>(least(most(along[i] * PER_KNOT, 0.0f), BINS - 1));
            ++ends[bin[i] + 1];
        }
        for (int b = 0; b < (SIDES + 1) * BINS; ++b) ends[b + 1] += ends[b];
        order_.resize(ends[(SIDES + 1) * BINS]);
        for (int i = 0; i < pixels_.count; ++i) {
            if (bin[i] != NOWHERE) order_[ends[bin[i]]++] = i;
        }
        count_ = static_cast<int>(order_.size());
        std::vector<int32_t> place(pixels_.count, NOWHERE);
        for (int32_t i = 0; i < count_; ++i) place[order_[i]] = i;
        for (int i = 0; i < pixels_.count; ++i) {
            if (place[i] == NOWHERE) continue;
            if (i % MEDIAN_STRIDE == 0) of_median_.push_back(place[i]);
            if (pixels_.limited[i]) limited_.push_back(place[i]);
        }
        pairs_.resize(pixels_.neighbour_rows);
        for (int axis = 0; axis < pixels_.neighbour_rows; ++axis) {
            const int64_t* neighbours = pixels_.neighbours + static_cast<int64_t>(axis) * pixels_.stride;
            for (int32_t i = 0; i < count_; ++i) {
                const int64_t other = neighbours[order_[i]];  // 0 for none
                if (other > 0 && other < pixels_.count && place[other] != NOWHERE) {
                    pairs_[axis].push_back({i, place[other]});
                }
            }
        }
    }

    // The coverage and its derivatives; coverage.blurred_coverage.
    void cover(const Quad& quad, double blur_px) {
        float matrix[3][SIDES][3];
        float per_length[SIDES];
        for (int s = 0; s < SIDES; ++s) {
            const double along = quad.tangent[s][0] * quad.corner[s][0] + quad.tangent[s][1] * quad.corner[s][1];
            const double off = quad.normal[s][0] * quad.corner[s][0] + quad.normal[s][1] * quad.corner[s][1];
            const double placed[3][3] = {
                {quad.normal[s][0], quad.normal[s][1], -off},
                {-quad.tangent[s][0], -quad.tangent[s][1], along},
                {-quad.tangent[s][0], -quad.tangent[s][1], along + quad.length[s]},
            };
            for (int p = 0; p < 3; ++p) {
                for (int axis = 0; axis < 3; ++axis) matrix[p][s][axis] = static_cast<float>(placed[p][axis] / blur_px);
            }
            per_length[s] = static_cast<float>(1 / std::max(quad.length[s] / blur_px, 1e-3));
        }
        const float per_blur = static_cast<float>(1 / blur_px);
        for (int begin = 0; begin < row_; begin += BLOCK) cover_block(begin, matrix, per_length, per_blur);
    }

    void cover_block(int begin, const float (&matrix)[3][SIDES][3], const float (&per_length)[SIDES], float per_blur) {
        const float* x = row(X) + begin;
        const float* y = row(Y) + begin;
        float inside[BLOCK], coverage[BLOCK] = {}, by_blur[BLOCK] = {};
        std::fill(inside, inside + BLOCK, 1.0f);
        int near_sides = 0;
        for (int s = 0; s < SIDES; ++s) {
            float across[BLOCK], start[BLOCK], end[BLOCK];
            for (int i = 0; i < BLOCK; ++i) {
                across[i] = matrix[0][s][0] * x[i] + matrix[0][s][1] * y[i] + matrix[0][s][2];
                start[i] = matrix[1][s][0] * x[i] + matrix[1][s][1] * y[i] + matrix[1][s][2];
                end[i] = matrix[2][s][0] * x[i] + matrix[2][s][1] * y[i] + matrix[2][s][2];
                inside[i] = across[i] < 0.0f ? inside[i] : 0.0f;
            }
            if (whereabouts(across) != 0) continue;
            const int of_start = whereabouts(start), of_end = whereabouts(end);
            if (of_start != 0 && of_start == of_end) continue;
            near_sides |= 1 << s;
            const Seen from = see(across, start, of_start), to = see(across, end, of_end);
            float by_start[BLOCK], by_end[BLOCK];
            for (int i = 0; i < BLOCK; ++i) {
                const float density = normal_pdf(across[i]) * per_blur;
                const float share = to.share[i] - from.share[i];
                const float at_end = (from.density[i] - to.density[i] - start[i] * share) * per_length[s];
                by_end[i] = density * at_end;
                by_blur[i] += density * share * across[i];
                by_start[i] = density * share - by_end[i];
                const float beyond = to.triangle[i] - from.triangle[i];
                coverage[i] += across[i] < 0.0f ? -beyond : beyond;
            }
            std::copy_n(by_start, BLOCK, row(BY_SHAPE + s) + begin);
            std::copy_n(by_end, BLOCK, row(BY_SHAPE + SIDES + s) + begin);
        }
        near_[begin / BLOCK] = near_sides;
        std::copy_n(by_blur, BLOCK, row(BY_SHAPE + BLUR) + begin);
        for (int i = 0; i < BLOCK; ++i) coverage[i] += inside[i];
        std::copy_n(coverage, BLOCK, row(COVERAGE) + begin);
    }

    // 1 or -1 if all of a block is so far on that side of 0, in blurs, that nothing changes any more; else 0.
    static int whereabouts(const float (&at)[BLOCK]) {
        int above = 0, below = 0;
        for (int i = 0; i < BLOCK; ++i) {
            above += at[i] >= FAR_BLURS;
            below += at[i] <= -FAR_BLURS;
        }
        return (above == BLOCK) - (below == BLOCK);
    }

    // How pixels see one end of a side: the normal's share and density there, and T(h, end).
    struct Seen {
        float share[BLOCK], density[BLOCK], triangle[BLOCK];
    };

    // The same of a block for which the end is ``where`` whereabouts() says.
    Seen see(const float (&across)[BLOCK], const float (&end)[BLOCK], int where) const {
        Seen seen;
        const float cells = table_.cells_per_blur;
        const float last_row = cells * table_.reach - 1.01f, last_column = cells * table_.reach * 2 - 1.01f;
        int32_t place[BLOCK];
        float down[BLOCK], right[BLOCK];
        for (int i = 0; i < BLOCK; ++i) {
            const float size = across[i] < 0.0f ? -across[i] : across[i];
            const float v = least(most(size * cells, 0.0f), last_row);
            const float u = least(most((end[i] + table_.reach) * cells, 0.0f), last_column);
            const int32_t row = static_cast<int32_t>(v), column = static_cast<int32_t>(u);
            place[i] = row * table_.columns + column;
            down[i] = v - static_cast<float>(row);
            right[i] = u - static_cast<float>(column);
        }
        if (where != 0) {
            std::fill_n(seen.share, BLOCK, 0.5f * where);
            std::fill_n(seen.density, BLOCK, 0.0f);
            for (int i = 0; i < BLOCK; ++i) {
                const float upper = table_.values[place[i]], lower = table_.values[place[i] + table_.columns];
                seen.triangle[i] = upper + down[i] * (lower - upper);
            }
            return seen;
        }
        for (int i = 0; i < BLOCK; ++i) {
            seen.share[i] = normal_share(end[i]);
            seen.density[i] = normal_pdf(end[i]);
        }
        for (int i = 0; i < BLOCK; ++i) {
            const float *above = table_.values + place[i], *below = above + table_.columns;
            const float upper = above[0] + right[i] * (above[1] - above[0]);
            const float lower = below[0] + right[i] * (below[1] - below[0]);
            seen.triangle[i] = upper + down[i] * (lower - upper);
        }
        return seen;
    }

    // Light and contrast of least squares, the logarithm taken as linear in the coverage.
    void first_light(Unknowns& unknowns) {
        double matrix[KNOTS + 1][KNOTS + 1], solution[KNOTS + 1];
        float* weighted = row(WEIGHTED);
        for (int k = 0; k <= KNOTS; ++k) {
            const float* basis = row(k < KNOTS ? HATS + k : static_cast<int>(COVERAGE));
            const float* use = row(USE);
            for (int i = 0; i < row_; ++i) weighted[i] = basis[i] * use[i];
            for (int other = 0; other <= k; ++other) {
                matrix[k][other] = product(weighted, row(other < KNOTS ? HATS + other : static_cast<int>(COVERAGE)), row_);
                if (k < KNOTS) matrix[k][other] += rules_.roughness[k][other];
                matrix[other][k] = matrix[k][other];
            }
            matrix[k][k] += 1e-6;
            solution[k] = product(weighted, row(VALUES), row_);
        }
        matrix[KNOTS][KNOTS] += 1 / (rules_.contrast_sigma * rules_.contrast_sigma);
        solve_symmetric(matrix, solution);
        const double contrast = solution[KNOTS];
        *unknowns.expected_contrast = contrast < 0 ? -rules_.contrast : rules_.contrast;
        std::copy(solution, solution + KNOTS, unknowns.light);
        *unknowns.contrast = std::clamp(contrast, -rules_.most_contrast, rules_.most_contrast);
    }

    // The residuals of log grey, in units of the light on the ground, and which pixels are used.
    void explain(const Unknowns& unknowns) {
        const float gain = std::exp(static_cast<float>(*unknowns.contrast)) - 1;
        const float slope = static_cast<float>(*unknowns.slope);
        for (int begin = 0; begin < row_; begin += BLOCK) {
            const float *coverage = row(COVERAGE) + begin, *values = row(VALUES) + begin;
            const float *across = row(ACROSS) + begin, *use = row(USE) + begin;
            float light[BLOCK] = {}, ratio[BLOCK], residual[BLOCK];
            for (int k = 0; k < KNOTS; ++k) {
                const float at_knot = static_cast<float>(unknowns.light[k]);
                const float* hat = row(HATS + k) + begin;
                for (int i = 0; i < BLOCK; ++i) light[i] += at_knot * hat[i];
            }
            for (int i = 0; i < BLOCK; ++i) {
                ratio[i] = 1 + gain * least(most(coverage[i], 0.0f), 1.0f);
                residual[i] = (values[i] - (light[i] + slope * across[i] + logarithm(ratio[i]))) * ratio[i];
            }
            std::copy_n(ratio, BLOCK, row(RATIO) + begin);
            std::copy_n(residual, BLOCK, row(RESIDUAL) + begin);
            std::copy_n(use, BLOCK, row(USED) + begin);
        }
        float *residual = row(RESIDUAL), *used = row(USED);
        // Where the sensor was at its limit the truth is as bright or brighter.
        for (const int32_t i : limited_) {
            if (residual[i] < 0) used[i] = 0.0f;
        }
        for (int i = 0; i < row_; ++i) residual[i] *= used[i];
    }

    // The median size of every few residuals of pixels that are used; 0 where there is none.
    float median_size() {
        const float *residual = row(RESIDUAL), *used = row(USED);
        float* sizes = row(SCRATCH);
        int count = 0;
        for (const int32_t i : of_median_) {
            if (used[i] > 0) sizes[count++] = std::abs(residual[i]);
        }
        if (count == 0) return 0.0f;
        const int middle = std::max(count / 2 - 1, 0);
        std::nth_element(sizes, sizes + middle, sizes + count);
        return sizes[middle];
    }

    // How much every pixel counts; robust.pixel_weights.
    void weigh(double least_scatter, Equations& equations) {
        const float *residual = row(RESIDUAL), *used = row(USED);
        float *robust = row(ROBUST), *square = row(SCRATCH);
        const double scale = std::max(rules_.sigma_of_mad * median_size(), std::max(rules_.min_scatter, least_scatter));
        const float per_scale = static_cast<float>(1 / (rules_.cauchy * scale));
        for (int i = 0; i < row_; ++i) {
            const float size = residual[i] * per_scale;
            robust[i] = used[i] / (1 + size * size);
            square[i] = robust[i] * residual[i] * residual[i];
        }
        const double counted = sum(robust, row_);
        const double shared = sum(square, row_) / std::max(counted, 1.0);
        double inflation = 1.0;
        for (const auto& pairs : pairs_) inflation *= correlation(pairs).inflation(rules_.max_correlation);
        float* weight = row(WEIGHT);
        std::fill(weight, weight + row_, 0.0f);
        const float* const both[2] = {square, robust};
        const float* const of_sides[SIDES] = {row(OF_SIDE), row(OF_SIDE + 1), row(OF_SIDE + 2), row(OF_SIDE + 3)};
        float totals[2][SIDES];
        products(both, of_sides, row_, totals);
        for (int s = 0; s < SIDES; ++s) {
            const float* of_side = of_sides[s];
            const double variance = std::max(
                (totals[0][s] + rules_.shared_pixels * shared) / (totals[1][s] + rules_.shared_pixels),
                rules_.min_scatter * rules_.min_scatter);
            equations.scatter[s] = std::sqrt(variance);
            const float per_pixel = static_cast<float>(1 / (variance * inflation));
            for (int i = 0; i < row_; ++i) weight[i] += robust[i] * of_side[i] * per_pixel;
        }
        *equations.inliers = counted / std::max(sum(used, row_), 1.0);
    }

    // How far residuals are alike at pairs of neighbours.
    Correlation correlation(const std::vector<Pair>& pairs) {
        const float *residual = row(RESIDUAL), *robust = row(ROBUST);
        Correlation total;
        for (const Pair& pair : pairs) {
            const float weight = robust[pair.first] * robust[pair.second];
            const float first = residual[pair.first], second = residual[pair.second];
            total.power += weight * (first * first + second * second);
            total.product += weight * first * second;
        }
        return total;
    }

    // Sums of products, each of every LANES-th pixel, of the unknowns' derivatives and, last, of residuals.
    using Sums = float[UNKNOWNS + 1][UNKNOWNS + 1][LANES];

    // The normal equations of the weighted residuals, and of those of the paint; robust.add_paint.
    void square(double contrast, Matrix& information, Vector& gradient) {
        const float gain = std::exp(static_cast<float>(contrast)) - 1;
        Sums sums = {};
        for (int begin = 0; begin < row_; begin += BLOCK) add_block(begin, gain, sums);
        double factor[UNKNOWNS];
        std::fill(factor, factor + UNKNOWNS, 1.0);
        std::fill(factor, factor + BLUR + 1, gain);
        factor[CONTRAST] = gain + 1;
        for (int u = 0; u < UNKNOWNS; ++u) {
            for (int other = 0; other <= u; ++other) {
                const double of_pair = u < BLUR ? 1.0 : factor[u] * factor[other];
                information[u][other] = information[other][u] = of_pair * sum(sums[u][other], LANES);
            }
            gradient[u] = (u < BLUR ? 1.0 : factor[u]) * sum(sums[UNKNOWNS][u], LANES);
        }
    }

    // Add the products of a block: of sides with their final weight, all else as if contrast's factors were 1.
    void add_block(int begin, float gain, Sums& sums) {
        float light[KNOTS + 1][BLOCK];
        const float* rows[UNKNOWNS];
        int unknown[UNKNOWNS], count = 0;
        const int near_sides = near_[begin / BLOCK], lit = lit_[begin / BLOCK];
        const float *coverage = row(COVERAGE) + begin, *ratio = row(RATIO) + begin, *across = row(ACROSS) + begin;
        for (int u = 0; u < BLUR; ++u) {
            if (near_sides >> u % SIDES & 1) unknown[count++] = u;
        }
        if (near_sides != 0) unknown[count++] = BLUR;
        for (int n = 0; n < count; ++n) rows[n] = row(BY_SHAPE + unknown[n]) + begin;
        rows[count] = coverage;
        unknown[count++] = CONTRAST;
        for (int k = 0; k < KNOTS; ++k) {
            if (!(lit >> k & 1)) continue;
            const float* hat = row(HATS + k) + begin;
            for (int i = 0; i < BLOCK; ++i) light[k][i] = hat[i] * ratio[i];
            rows[count] = light[k];
            unknown[count++] = LIGHT + k;
        }
        for (int i = 0; i < BLOCK; ++i) light[KNOTS][i] = across[i] * ratio[i];
        rows[count] = light[KNOTS];
        unknown[count++] = SLOPE;

        const float *weight = row(WEIGHT) + begin, *residual = row(RESIDUAL) + begin;
        float of_sides[BLOCK], pull[BLOCK], pull_of_sides[BLOCK];
        for (int i = 0; i < BLOCK; ++i) {
            pull[i] = weight[i] * residual[i];
            of_sides[i] = gain * gain * weight[i];
            pull_of_sides[i] = gain * pull[i];
        }
        if (pixels_.paint != nullptr) add_paint(begin, of_sides, pull_of_sides);
        for (int n = 0; n < count; ++n) {
            const int u = unknown[n];
            const float* of_pixel = u < BLUR ? of_sides : weight;
            float weighted[BLOCK];
            for (int i = 0; i < BLOCK; ++i) weighted[i] = rows[n][i] * of_pixel[i];
            for (int m = 0; m <= n; ++m) add_products(weighted, rows[m], sums[u][unknown[m]]);
            add_products(rows[n], u < BLUR ? pull_of_sides : pull, sums[UNKNOWNS][u]);
        }
    }

    // Add to weights, and to weighted residuals, of sides that the network's probability of paint is the coverage.
    void add_paint(int begin, float (&of_sides)[BLOCK], float (&pull_of_sides)[BLOCK]) {
        const float *paint = row(PAINT) + begin, *coverage = row(COVERAGE) + begin, *use = row(USE) + begin;
        const float per_sigma = static_cast<float>(1 / (rules_.cauchy * rules_.paint_sigma));
        const float per_variance = static_cast<float>(1 / (rules_.paint_sigma * rules_.paint_sigma));
        for (int i = 0; i < BLOCK; ++i) {
            const float residual = paint[i] - coverage[i];
            const float size = residual * per_sigma;
            const float weight = use[i] * per_variance / (1 + size * size);
            of_sides[i] += weight;
            pull_of_sides[i] += weight * residual;
        }
    }

    // Add the products of a block's numbers.
    static void add_products(const float* a, const float* b, float (&sums)[LANES]) {
        float totals[LANES];
        std::copy_n(sums, LANES, totals);
        for (int begin = 0; begin < BLOCK; begin += LANES) {
            for (int i = 0; i < LANES; ++i) totals[i] += a[begin + i] * b[begin + i];
        }
        std::copy_n(totals, LANES, sums);
    }

    // Add the outline, the typical blur and contrast, and that light changes little; State._add_priors.
    void add_priors(const Quad& quad, const Unknowns& unknowns, Matrix& information, Vector& gradient) const {
        add_outline(quad, unknowns, information, gradient);
        add_closure(quad, unknowns, information, gradient);
        const double per_blur = 1 / (rules_.blur_sigma_px * rules_.blur_sigma_px);
        information[BLUR][BLUR] += per_blur;
        if (pixels_.paint != nullptr) {
            information[BLUR][BLUR] += rules_.held;
        } else {
            gradient[BLUR] += (unknowns.expected_blur_px - *unknowns.blur_px) * per_blur;
        }
        const double per_contrast = 1 / (rules_.contrast_sigma * rules_.contrast_sigma);
        information[CONTRAST][CONTRAST] += per_contrast;
        gradient[CONTRAST] += (*unknowns.expected_contrast - *unknowns.contrast) * per_contrast;
        for (int k = 0; k < KNOTS; ++k) {
            for (int other = 0; other < KNOTS; ++other) {
                information[LIGHT + k][LIGHT + other] += rules_.roughness[k][other];
                gradient[LIGHT + k] -= rules_.roughness[k][other] * unknowns.light[other];
            }
        }
        const double per_slope = 1 / (rules_.light_step * rules_.light_step);
        information[SLOPE][SLOPE] += per_slope;
        gradient[SLOPE] -= *unknowns.slope * per_slope;
    }

    static void add_outline(const Quad& quad, const Unknowns& unknowns, Matrix& information, Vector& gradient) {
        for (int s = 0; s < SIDES; ++s) {
            for (int end = 0; end < 2; ++end) {
                const int c = (s + end) % SIDES;
                const int place = s + end * SIDES;
                double off = 0.0;
                for (int axis = 0; axis < 2; ++axis) {
                    off += (unknowns.outline[2 * c + axis] - quad.corner[c][axis]) * quad.normal[s][axis];
                }
                const double sigma_px = unknowns.outline_sigma_px[place];
                information[place][place] += 1 / (sigma_px * sigma_px);
                gradient[place] += off / (sigma_px * sigma_px);
            }
        }
    }

    static void add_closure(const Quad& quad, const Unknowns& unknowns, Matrix& information, Vector& gradient) {
        for (int axis = 0; axis < 2; ++axis) {
            const double* by_corner = unknowns.closure + axis * 2 * SIDES;
            double by_side[2 * SIDES];
            double gap = unknowns.gap[axis];
            for (int c = 0; c < SIDES; ++c) {
                double by_start[2], by_end[2];
                quad.slides(c, by_start, by_end);
                const double* by_place = by_corner + 2 * c;
                by_side[c] = by_place[0] * by_start[0] + by_place[1] * by_start[1];
                by_side[SIDES + (c + SIDES - 1) % SIDES] = by_place[0] * by_end[0] + by_place[1] * by_end[1];
                for (int d = 0; d < 2; ++d) gap += by_place[d] * (quad.corner[c][d] - unknowns.outline[2 * c + d]);
            }
            for (int u = 0; u < 2 * SIDES; ++u) {
                for (int other = 0; other < 2 * SIDES; ++other) information[u][other] += by_side[u] * by_side[other];
                gradient[u] -= gap * by_side[u];
            }
        }
    }

    void move(const Quad& quad, const Vector& step, Unknowns& unknowns, Equations& equations) const {
        const double most_px = rules_.most_step * *unknowns.blur_px;
        for (int u = 0; u < BLUR; ++u) equations.side_step[u] = std::clamp(step[u], -most_px, most_px);
        quad.moved(equations.side_step, unknowns.corners);
        if (pixels_.paint == nullptr) {
            *unknowns.blur_px = std::clamp(*unknowns.blur_px + step[BLUR], rules_.least_blur_px, rules_.most_blur_px);
        }
        *unknowns.contrast += std::clamp(step[CONTRAST], -rules_.most_contrast_step, rules_.most_contrast_step);
        for (int k = 0; k < KNOTS; ++k) unknowns.light[k] += step[LIGHT + k];
        *unknowns.slope += step[SLOPE];
    }

    const Pixels& pixels_;
    const OwenTable& table_;
    const FitRules& rules_;
    std::vector<int32_t> order_;               // the pixels that are used, as they are in the rows of the buffer
    int count_ = 0;                            // of them
    std::vector<int32_t> of_median_;           // places in the rows of every few of them, for a median
    std::vector<int32_t> limited_;             // places of those at which the sensor was at its limit
    std::vector<std::vector<Pair>> pairs_;     // places of neighbours, by axis
    int row_ = 0;                              // floats from one row of the buffer to the next
    std::vector<float> buffer_;
    std::vector<int32_t> near_;                // sides that a block is near, by bits
    std::vector<int32_t> lit_;                 // knots whose light a block is in, by bits
};

}  // namespace

void V2HDM_SETTLE(
    const Pixels& pixels,
    const OwenTable& table,
    const FitRules& rules,
    int steps,
    double scatter,
    Unknowns& unknowns,
    Equations& equations) {
    Fit fit(pixels, table, rules);
    for (int number = 0; number < steps; ++number) {
        fit.step(unknowns, scatter, equations);
        scatter /= 2;
        double longest_px = 0.0;
        for (int u = 0; u < 2 * SIDES; ++u) {
            const double size_px = std::abs(equations.side_step[u]);
            if (!(size_px <= longest_px)) longest_px = size_px;
        }
        // Not-a-number is not longer.
        if (!(longest_px > rules.settled_px) || !(*equations.decrement > rules.insignificant)) break;
    }
}

}  // namespace v2hdm
