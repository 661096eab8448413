#include "adjust.h"

#include <algorithm>
#include <cmath>

#define V2HDM_PASSES passes_anywhere
#include "adjust_body.h"

namespace v2hdm::adjust {

#ifdef V2HDM_AVX2
extern const Passes passes_avx2;
#endif

const Passes& passes() {
#ifdef V2HDM_AVX2
    static const bool has_avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
    if (has_avx2) return passes_avx2;
#endif
    return passes_anywhere;
}

}  // namespace v2hdm::adjust
