// The steps once more with the instructions of newer x86 processors.
#include "settle.h"

#include <algorithm>
#include <cmath>
#include <vector>

#ifdef V2HDM_AVX2
// From here on, so that nothing of the standard library is compiled so: other files may share that.
#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("avx2,fma"))), apply_to = function)
#else
#pragma GCC target("avx2,fma")
#endif

#define V2HDM_SETTLE settle_avx2
#include "products.h"
#include "quad.h"
#include "solve.h"
#include "vector_math.h"
#include "settle_body.h"

#if defined(__clang__)
#pragma clang attribute pop
#endif
#endif
