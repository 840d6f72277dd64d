/*
 * Names that are seen within an FMU alone, whatever the compiler is told of visibility: the C
 * library has an `advance` too, and would be called.
 *
 * And versions of mathematical functions that older C libraries have too:
 * glibc gave some of them new versions, which differ in how errors are reported and not in their
 * results; a binary that is linked on a new Linux would not load on an older one for their sake.
 */
#ifndef TERRAFIX_PORTABLE_H
#define TERRAFIX_PORTABLE_H

#include <math.h>

#if defined(__GNUC__) && !defined(_WIN32)
#define WITHIN __attribute__((visibility("hidden")))
#else
#define WITHIN
#endif

#if defined(__linux__) && defined(__x86_64__) && defined(__GLIBC__)
__asm__(".symver exp, exp@GLIBC_2.2.5");
__asm__(".symver log, log@GLIBC_2.2.5");
__asm__(".symver pow, pow@GLIBC_2.2.5");
__asm__(".symver fmod, fmod@GLIBC_2.2.5");
__asm__(".symver hypot, hypot@GLIBC_2.2.5");
#endif

#endif
