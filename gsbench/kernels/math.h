// The mathematics of one Gaussian and of one pixel: each function with its derivative, for all backends.
//
// The code is templated on a number type T: `float` on CUDA, with one Gaussian or pixel per thread, or a SIMD vector of
// sixteen floats on the CPU. Derivatives (`vjp`) are vector-Jacobian products: from the gradients of a function's
// outputs, they return or add the gradients of its inputs. Names of gradients start with g_.
#pragma once

#include "math/awake.h"
#include "math/blending.h"
#include "math/coupled.h"
#include "math/direct.h"
#include "math/direct_beta.h"
#include "math/free_time.h"
#include "math/harmonics.h"
#include "math/parameters.h"
#include "math/projection.h"
#include "math/rotated.h"
#include "math/scalar.h"
#include "math/sharp_time.h"
#include "math/similarity.h"
#include "math/slicing.h"
#include "math/static.h"
#include "math/static_triangular.h"
#include "math/triangular.h"
