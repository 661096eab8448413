// The passes, for the processor that the file which includes this is compiled for, as V2HDM_PASSES.
#include "adjust_parts.h"
#include "adjust_batch.h"
#include "adjust_linearise.h"
#include "adjust_evaluate.h"
#include "adjust_ground.h"
#include "adjust_lay_out.h"
#include "adjust_substitute.h"

namespace v2hdm::adjust {

extern const Passes V2HDM_PASSES;
const Passes V2HDM_PASSES = {
    linearise, subtract_frames, evaluate, carry, lay_out, meet_ground, report, residuals, pull, couplings, forward, backward,
};

}  // namespace v2hdm::adjust
