/* Cosine and sine of 2 pi x for -1/2 <= x <= 1/2, to 3e-7: from half the angle. */
static inline void turn(float x, float *c, float *s)
{
    const float q = x * x;
    float si = q * 0.0776576603f - 0.598291286f, co = q * 0.219689611f - 1.33187657f;
    si = q * si + 2.55007752f;
    co = q * co + 4.05841135f;
    si = q * si - 5.16771008f;
    co = q * co - 4.93479283f;
    si = x * (q * si + 3.14159264f);
    co = q * co + 0.999999953f;
    *c = 1.0f - 2.0f * si * si;
    *s = 2.0f * si * co;
}
