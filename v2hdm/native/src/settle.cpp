#include "settle.h"

#include <algorithm>
#include <cmath>
#include <vector>

#define V2HDM_SETTLE settle_anywhere
#include "products.h"
#include "quad.h"
#include "solve.h"
#include "vector_math.h"
#include "settle_body.h"

namespace v2hdm {

void settle(
    const Pixels& pixels,
    const OwenTable& table,
    const FitRules& rules,
    int steps,
    double scatter,
    Unknowns& unknowns,
    Equations& equations) {
#ifdef V2HDM_AVX2
    static const bool has_avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
    if (has_avx2) return settle_avx2(pixels, table, rules, steps, scatter, unknowns, equations);
#endif
    settle_anywhere(pixels, table, rules, steps, scatter, unknowns, equations);
}

}  // namespace v2hdm
