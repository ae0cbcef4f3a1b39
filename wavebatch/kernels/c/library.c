/* The library of kernels/: one compilation, arrays in, arrays out. Read decompose.h first, then fit.h and next_echo.h.

   No state is kept between calls. Python checks shapes and ranges before each call (kernels/library.py). */
#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif
#include "lanes.h"
#include "types.h"
#include "pulse.h"
#include "work.h"
#include "window.h"
#if defined(__GNUC__) && !defined(__clang__) /* loops over the few unknowns of a fit end before vectors of theirs would pay */
#pragma GCC push_options
#pragma GCC optimize("no-tree-loop-vectorize")
#endif
#include "fit.h"
#include "next_echo.h"
#include "decompose.h"
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC pop_options
#endif
#include "describe.h"
#include "signal.h"
#include "elementary.h"
#include "echoes.h"
#include "neighbours.h"
#include "finish.h"
#include "matched.h"
#include "returns.h"
#include "planes.h"
#include "stack.h"
#include "wdz.h"
#include "packets.h"
