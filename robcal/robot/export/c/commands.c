/* Forward model of the real robot and corrected commands. */
#include INVERSE

void ROBOT(forward)(const double q[N], const ROBOT(conditions) *conditions, double world_T_tool[12])
{
    double load[4];
    load[0] = conditions->payload.mass;
    load[1] = conditions->payload.cog[0];
    load[2] = conditions->payload.cog[1];
    load[3] = conditions->payload.cog[2];
    real_robot(q, load, conditions->covariate, world_T_tool);
}

void ROBOT(nominal_forward)(const double q[N], double base_T_tool[12])
{
    chain(q, base_T_tool, 0);
}

void ROBOT(base_from_world)(const double world_T_x[12], double base_T_x[12])
{
    multiply(BASE_T_WORLD, world_T_x, base_T_x);
}

void ROBOT(world_from_base)(const double base_T_x[12], double world_T_x[12])
{
    multiply(WORLD_T_BASE, base_T_x, world_T_x);
}

static int inside(const double *q)
{
    int i;
    for (i = 0; i < N; ++i) {
        if (!(q[i] <= UPPER[i] + LIMIT_TOLERANCE && q[i] >= LOWER[i] - LIMIT_TOLERANCE)) {
            return 0;
        }
    }
    return 1;
}

/* The nominal robot linearised: right twists of its tool per joint, and their normal matrix, factorised. */
typedef struct {
    double J[6 * N], L[N][N];
    int usable;
} linear;

static double weight(int k)
{
    return k < 3 ? 1.0 : ROTATION_LENGTH * ROTATION_LENGTH;
}

static void linearise(const double *q, linear *at)
{
    double T[12];
    int i, j, k;
    chain(q, T, at->J);
    for (i = 0; i < N; ++i) {
        for (j = 0; j <= i; ++j) {
            double s = 0.0;
            for (k = 0; k < 6; ++k) {
                s += weight(k) * at->J[6 * i + k] * at->J[6 * j + k];
            }
            /* a track under the arm stays where it is */
            at->L[i][j] = (j < HELD) ? (i == j) : s + (i == j ? 1e-14 : 0.0);
        }
    }
    at->usable = factorise(at->L);
}

/* Joint step by the twist r of the tool; 0 if a limit or a singularity forbids it. */
static int step(linear *at, const double *r, double *q)
{
    double b[N], next[N], largest = 0.0;
    int i, k;
    if (!at->usable) {
        return 0;
    }
    for (i = 0; i < N; ++i) {
        b[i] = 0.0;
        for (k = 0; k < 6 && i >= HELD; ++k) {
            b[i] += weight(k) * at->J[6 * i + k] * r[k];
        }
    }
    substitute(at->L, b);
    for (i = 0; i < N; ++i) {
        largest = fmax(largest, fabs(b[i]));
    }
    for (i = 0; i < N; ++i) {
        next[i] = q[i] + b[i] * (largest > LARGEST_STEP ? LARGEST_STEP / largest : 1.0);
    }
    if (!inside(next)) {
        return 0;
    }
    memcpy(q, next, sizeof next);
    return 1;
}

/* One correction: F* <- F* Fh^-1 F with F* = K(q), then its joint values. */
static int correct(const double *F, const double *real, double *q)
{
#if N >= 6
    double Fh[12], T[12], inverse[12], gap[12], target[12], next[N];
    int result, i;
    multiply(BASE_T_WORLD, real, Fh);
    chain(q, T, 0);
    invert(Fh, inverse);
    multiply(inverse, F, gap);
    multiply(T, gap, target);
    result = ROBOT(nominal_inverse)(target, q, next);
    for (i = 0; i < N && result == ROBOT(OK); ++i) {
        /* a correction must not change the configuration */
        if (fabs(next[i] - q[i]) > FLIP) {
            result = ROBOT(OUT_OF_REACH);
        }
    }
    if (result == ROBOT(OK)) {
        memcpy(q, next, sizeof next);
    }
    return result;
#else
    /* fewer than six joints: position before orientation, in joint space */
    linear at;
    double target[12], r[6];
    multiply(WORLD_T_BASE, F, target);
    difference(real, target, r);
    linearise(q, &at);
    return step(&at, r, q) ? ROBOT(OK) : ROBOT(BEYOND_LIMITS);
#endif
}

int ROBOT(first_order)(const double world_T_tool[12], const ROBOT(conditions) *conditions, const double near[N],
                    double q[N], double *base_T_target)
{
    double F[12], real[12];
    int result;
    multiply(BASE_T_WORLD, world_T_tool, F);
    result = ROBOT(nominal_inverse)(F, near, q);
    if (result == ROBOT(OK)) {
        ROBOT(forward)(q, conditions, real);
        result = correct(F, real, q);
    }
    if (base_T_target) {
        chain(q, base_T_target, 0);
    }
    return result;
}

int ROBOT(exact)(const double world_T_tool[12], const ROBOT(conditions) *conditions, const double near[N],
              double q[N], double *base_T_target, double *remaining)
{
    linear at;
    double F[12], real[12], r[6], back[6], size = HUGE_VAL, before;
    int result, round, k, quick = 1, fresh = 1;
    multiply(BASE_T_WORLD, world_T_tool, F);
    result = ROBOT(nominal_inverse)(F, near, q);
    for (round = 0; result == ROBOT(OK); ++round) {
        ROBOT(forward)(q, conditions, real);
        difference(world_T_tool, real, r);
        before = size;
        size = 0.0;
        for (k = 0; k < 6; ++k) {
            size = (k < 3 || N >= 6) ? fmax(size, fabs(r[k])) : size;
            back[k] = -r[k];
        }
        if (size <= 1e-10) {
            break;
        }
        if (round == 25) {
            result = ROBOT(NOT_CONVERGED);
            break;
        }
        /* joint steps while they gain much, by one linearisation as long as it serves well; near singularities the
         * closed form of the corrected target */
        quick = quick && size < 0.25 * before;
        if (quick && (fresh || size > 0.02 * before)) {
            linearise(q, &at);
            fresh = 0;
        }
        if (!(quick && step(&at, back, q))) {
            quick = 0;
            result = correct(F, real, q);
        }
    }
    if (base_T_target) {
        chain(q, base_T_target, 0);
    }
    if (remaining) {
        *remaining = size < HUGE_VAL ? sqrt(dot(r, r)) : HUGE_VAL;
    }
    return result;
}
