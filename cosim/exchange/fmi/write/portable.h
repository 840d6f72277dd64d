/*
 * Versions of mathematical functions that older C libraries have too.
 *
 * glibc gave some of them new versions, which differ in how errors are reported and not in their
 * results; a binary that is linked on a new Linux would not load on an older one for their sake.
 */
#ifndef TERRAFIX_PORTABLE_H
#define TERRAFIX_PORTABLE_H

#include <math.h>

#if defined(__linux__) && defined(__x86_64__) && defined(__GLIBC__)
__asm__(".symver exp, exp@GLIBC_2.2.5");
__asm__(".symver log, log@GLIBC_2.2.5");
__asm__(".symver pow, pow@GLIBC_2.2.5");
__asm__(".symver fmod, fmod@GLIBC_2.2.5");
__asm__(".symver hypot, hypot@GLIBC_2.2.5");
#endif

#endif
