// Substitution of one column in a factor of tiles; twin of v2hdm.adjust.kernels.substitute.
namespace v2hdm::adjust {
namespace {

double dot(const double* a, const double* b, Index count) {
    double sum = 0.0;
    for (Index i = 0; i < count; ++i) sum += a[i] * b[i];
    return sum;
}

// Subtracts a multiple of ``row`` from ``out``.
void subtract(double* out, const double* row, double factor, Index count) {
    for (Index i = 0; i < count; ++i) out[i] -= row[i] * factor;
}

void forward(const Factor& factor, double* out) {
    const Index size = factor.size;
    for (Index g = 0; g < factor.columns; ++g) {
        double* part = out + g * size;
        const double* tile = factor.values + factor.at[g];
        for (Index i = 0; i < size; ++i) part[i] = (part[i] - dot(tile + i * size, part, i)) / tile[i * size + i];
        const double* panel = tile + size * size;
        for (Index k = factor.begin[g]; k < factor.begin[g + 1]; ++k) {
            out[factor.rows[k]] -= dot(panel + (k - factor.begin[g]) * size, part, size);
        }
    }
    double* part = out + factor.columns * size;
    for (Index i = 0; i < factor.tip_size; ++i) {
        const double* row = factor.tip + i * factor.tip_size;
        part[i] = (part[i] - dot(row, part, i)) / row[i];
    }
}

void backward(const Factor& factor, double* out) {
    const Index size = factor.size;
    double* tip = out + factor.columns * size;
    for (Index i = factor.tip_size - 1; i >= 0; --i) {
        const double* row = factor.tip + i * factor.tip_size;
        tip[i] /= row[i];
        subtract(tip, row, tip[i], i);
    }
    for (Index g = factor.columns - 1; g >= 0; --g) {
        double* part = out + g * size;
        const double *tile = factor.values + factor.at[g], *panel = tile + size * size;
        for (Index k = factor.begin[g]; k < factor.begin[g + 1]; ++k) {
            subtract(part, panel + (k - factor.begin[g]) * size, out[factor.rows[k]], size);
        }
        for (Index i = size - 1; i >= 0; --i) {
            part[i] /= tile[i * size + i];
            subtract(part, tile + i * size, part[i], i);
        }
    }
}

}  // namespace
}  // namespace v2hdm::adjust
