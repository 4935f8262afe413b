"""The fixed parts of exported C beside the inverse: header, vectors, chain, corrected commands.

Plain C99 with ``math.h`` alone. ``@P@`` is the prefix of all names. The mathematics is that of
:mod:`robcal.robot.chain` and :mod:`robcal.robot.compensation`; frames are 3 x 4 matrices, row by row.
"""

HEADER = r"""/* @TITLE@
 * Forward model and corrected commands of a calibrated robot. C99, no dependencies but math.h, no allocation.
 * Units: metres, radians, kilograms. Frames: the upper three rows of a homogeneous matrix, row by row (12 numbers).
 * Joint values are those of the controller (sense of q). world: the measuring system; base: the calibrated robot base.
 */
#ifndef @P@_H
#define @P@_H

#define @P@_JOINTS @N@
#define @P@_COVARIATES @COVARIATES@@COVARIATE_NOTE@

typedef struct {
    double mass;   /* kg; 0 is no payload */
    double cog[3]; /* centre of gravity in flange coordinates */
} @P@_payload;

typedef struct {
    @P@_payload payload;
    double covariate[@COVARIATE_SIZE@]; /* in the order given above; 0 where not known */
} @P@_conditions;
@PAYLOADS@
/* Results of the functions below. */
enum { @P@_OK = 0, @P@_BEYOND_LIMITS = 1, @P@_OUT_OF_REACH = 2, @P@_NOT_CONVERGED = 3 };

/* Where the real tool is. */
void @P@_forward(const double q[@N@], const @P@_conditions *conditions, double world_T_tool[12]);

/* Where the controller believes the tool is, in base coordinates. */
void @P@_nominal_forward(const double q[@N@], double base_T_tool[12]);

/* Joint values of the nominal robot for a tool frame in base coordinates, within limits, nearest to near. */
int @P@_nominal_inverse(const double base_T_tool[12], const double near[@N@], double q[@N@]);

/* Frames between the two coordinate systems. */
void @P@_base_from_world(const double world_T_x[12], double base_T_x[12]);
void @P@_world_from_base(const double base_T_x[12], double world_T_x[12]);

/* Command that brings the real tool to a frame, to first order: F* = F Fh^-1 F.
 * q: joint values to command; base_T_target (may be NULL): the corrected Cartesian target in base coordinates. */
int @P@_first_order(const double world_T_tool[12], const @P@_conditions *conditions, const double near[@N@],
                    double q[@N@], double *base_T_target);

/* The same, iterated until the real model is at the frame. remaining (may be NULL): distance left in m. */
int @P@_exact(const double world_T_tool[12], const @P@_conditions *conditions, const double near[@N@],
              double q[@N@], double *base_T_target, double *remaining);

#endif
"""

VECTORS = r"""
#define TURN 6.28318530717958647693
#define SLACK 1e-9
#define EDGE 1e-9

static double dot(const double *a, const double *b)
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static void cross(const double *a, const double *b, double *c)
{
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

static void turn(const double *R, const double *a, double *b)
{
    b[0] = R[0] * a[0] + R[1] * a[1] + R[2] * a[2];
    b[1] = R[4] * a[0] + R[5] * a[1] + R[6] * a[2];
    b[2] = R[8] * a[0] + R[9] * a[1] + R[10] * a[2];
}

static void multiply(const double *A, const double *B, double *C)
{
    int i, j;
    for (i = 0; i < 3; ++i) {
        for (j = 0; j < 4; ++j) {
            C[4 * i + j] = A[4 * i] * B[j] + A[4 * i + 1] * B[4 + j] + A[4 * i + 2] * B[8 + j];
        }
        C[4 * i + 3] += A[4 * i + 3];
    }
}

static void invert(const double *A, double *B)
{
    int i, j;
    for (i = 0; i < 3; ++i) {
        for (j = 0; j < 3; ++j) {
            B[4 * i + j] = A[4 * j + i];
        }
        B[4 * i + 3] = -(A[i] * A[3] + A[4 + i] * A[7] + A[8 + i] * A[11]);
    }
}

/* Rodrigues: u turned about w */
static void rotate_cs(const double *w, double c, double s, const double *u, double *v)
{
    double d = dot(w, u) * (1.0 - c), x[3];
    cross(w, u, x);
    v[0] = c * u[0] + s * x[0] + d * w[0];
    v[1] = c * u[1] + s * x[1] + d * w[1];
    v[2] = c * u[2] + s * x[2] + d * w[2];
}

/* Twist (rho, omega) that moves A onto B, in the coordinates of A. */
static void difference(const double *A, const double *B, double *twist)
{
    double I[12], C[12], q[4], n, sine, angle, factor;
    int i;
    invert(A, I);
    multiply(I, B, C);
    twist[0] = C[3];
    twist[1] = C[7];
    twist[2] = C[11];
    if (C[0] + C[5] + C[10] > 0.0) {
        q[0] = 1.0 + C[0] + C[5] + C[10];
        q[1] = C[9] - C[6];
        q[2] = C[2] - C[8];
        q[3] = C[4] - C[1];
    } else if (C[0] >= C[5] && C[0] >= C[10]) {
        q[0] = C[9] - C[6];
        q[1] = 1.0 + C[0] - C[5] - C[10];
        q[2] = C[4] + C[1];
        q[3] = C[2] + C[8];
    } else if (C[5] >= C[10]) {
        q[0] = C[2] - C[8];
        q[1] = C[4] + C[1];
        q[2] = 1.0 + C[5] - C[0] - C[10];
        q[3] = C[9] + C[6];
    } else {
        q[0] = C[4] - C[1];
        q[1] = C[2] + C[8];
        q[2] = C[9] + C[6];
        q[3] = 1.0 + C[10] - C[0] - C[5];
    }
    n = sqrt(q[0] * q[0] + dot(q + 1, q + 1));
    if (q[0] < 0.0) {
        n = -n;
    }
    for (i = 0; i < 4; ++i) {
        q[i] /= n;
    }
    sine = sqrt(dot(q + 1, q + 1));
    angle = 2.0 * atan2(sine, q[0]);
    factor = sine < 5e-7 ? 2.0 : angle / sine;
    for (i = 0; i < 3; ++i) {
        twist[3 + i] = factor * q[1 + i];
    }
}

/* Rotary joints by whole turns: near the wanted value, within limits; returns 1 if all limits hold. */
static int turn_near(double *q, const double *near)
{
    int i, inside = 1;
    for (i = 0; i < N; ++i) {
        if (!PRISMATIC[i]) {
            double high, low;
            q[i] -= TURN * floor((q[i] - near[i]) / TURN + 0.5);
            high = q[i] - UPPER[i] - SLACK;
            low = LOWER[i] - SLACK - q[i];
            if (high > 0.0) {
                q[i] -= TURN * ceil(high / TURN);
            } else if (low > 0.0) {
                q[i] += TURN * ceil(low / TURN);
            }
        }
        if (q[i] > UPPER[i] + SLACK || q[i] < LOWER[i] - SLACK) {
            inside = 0;
        }
    }
    return inside;
}
"""

CHAIN = r"""
/* Nominal frame of the tool in base coordinates; with J also its right twist per joint (column i at J + 6 * i). */
static void chain(const double *q, double *T, double *J)
{
    double R[12] = {1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0}, axes[N][3], points[N][3];
    int i, k;
    for (i = 0; i < N; ++i) {
        double E[12], C[12], column[3], image[3];
        turn(R, AXIS[i], axes[i]);
        turn(R, POINT[i], points[i]);
        points[i][0] += R[3];
        points[i][1] += R[7];
        points[i][2] += R[11];
        if (PRISMATIC[i]) {
            for (k = 0; k < 3; ++k) {
                R[4 * k + 3] += q[i] * axes[i][k];
            }
            continue;
        }
        {
            double c = cos(q[i]), s = sin(q[i]);
            for (k = 0; k < 3; ++k) {
                column[0] = column[1] = column[2] = 0.0;
                column[k] = 1.0;
                rotate_cs(AXIS[i], c, s, column, image);
                E[k] = image[0];
                E[4 + k] = image[1];
                E[8 + k] = image[2];
            }
        }
        turn(E, POINT[i], image);
        E[3] = POINT[i][0] - image[0];
        E[7] = POINT[i][1] - image[1];
        E[11] = POINT[i][2] - image[2];
        multiply(R, E, C);
        memcpy(R, C, sizeof R);
    }
    multiply(R, HOME, T);
    if (!J) {
        return;
    }
    for (i = 0; i < N; ++i) {
        double arm[3], rho[3], omega[3] = {0.0, 0.0, 0.0};
        if (PRISMATIC[i]) {
            memcpy(rho, axes[i], sizeof rho);
        } else {
            arm[0] = T[3] - points[i][0];
            arm[1] = T[7] - points[i][1];
            arm[2] = T[11] - points[i][2];
            cross(axes[i], arm, rho);
            memcpy(omega, axes[i], sizeof omega);
        }
        for (k = 0; k < 3; ++k) {
            J[6 * i + k] = T[k] * rho[0] + T[4 + k] * rho[1] + T[8 + k] * rho[2];
            J[6 * i + 3 + k] = T[k] * omega[0] + T[4 + k] * omega[1] + T[8 + k] * omega[2];
        }
    }
}
"""

COMMANDS = r"""
void @P@_forward(const double q[N], const @P@_conditions *conditions, double world_T_tool[12])
{
    double load[4];
    load[0] = conditions->payload.mass;
    load[1] = conditions->payload.cog[0];
    load[2] = conditions->payload.cog[1];
    load[3] = conditions->payload.cog[2];
    real_robot(q, load, conditions->covariate, world_T_tool);
}

void @P@_nominal_forward(const double q[N], double base_T_tool[12])
{
    chain(q, base_T_tool, 0);
}

void @P@_base_from_world(const double world_T_x[12], double base_T_x[12])
{
    multiply(BASE_T_WORLD, world_T_x, base_T_x);
}

void @P@_world_from_base(const double base_T_x[12], double world_T_x[12])
{
    multiply(WORLD_T_BASE, base_T_x, world_T_x);
}

static int inside(const double *q)
{
    int i;
    for (i = 0; i < N; ++i) {
        if (!(q[i] <= UPPER[i] + SLACK && q[i] >= LOWER[i] - SLACK)) {
            return 0;
        }
    }
    return 1;
}

/* Joint step of the nominal robot by the twist r of its tool; 0 if a limit or a singularity forbids it. */
static int step(const double *r, double *q)
{
    double T[12], J[6 * N], A[N][N], b[N], next[N], largest = 0.0;
    int i, j, k;
    chain(q, T, J);
    for (i = 0; i < N; ++i) {
        for (j = 0; j <= i; ++j) {
            double s = 0.0;
            for (k = 0; k < 6; ++k) {
                s += (k < 3 ? 1.0 : ROTATION_LENGTH * ROTATION_LENGTH) * J[6 * i + k] * J[6 * j + k];
            }
            /* a track under the arm stays where it is */
            A[i][j] = A[j][i] = (j < HELD) ? (i == j) : s + (i == j ? 1e-14 : 0.0);
        }
        b[i] = 0.0;
        for (k = 0; k < 6 && i >= HELD; ++k) {
            b[i] += (k < 3 ? 1.0 : ROTATION_LENGTH * ROTATION_LENGTH) * J[6 * i + k] * r[k];
        }
    }
    if (!solve(A, b)) {
        return 0;
    }
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
    result = @P@_nominal_inverse(target, q, next);
    for (i = 0; i < N && result == @P@_OK; ++i) {
        /* a correction must not change the configuration */
        if (fabs(next[i] - q[i]) > FLIP) {
            result = @P@_OUT_OF_REACH;
        }
    }
    if (result == @P@_OK) {
        memcpy(q, next, sizeof next);
    }
    return result;
#else
    /* fewer than six joints: position before orientation, in joint space */
    double target[12], r[6];
    multiply(WORLD_T_BASE, F, target);
    difference(real, target, r);
    return step(r, q) ? @P@_OK : @P@_BEYOND_LIMITS;
#endif
}

int @P@_first_order(const double world_T_tool[12], const @P@_conditions *conditions, const double near[N],
                    double q[N], double *base_T_target)
{
    double F[12], real[12];
    int result;
    multiply(BASE_T_WORLD, world_T_tool, F);
    result = @P@_nominal_inverse(F, near, q);
    if (result == @P@_OK) {
        @P@_forward(q, conditions, real);
        result = correct(F, real, q);
    }
    if (base_T_target) {
        chain(q, base_T_target, 0);
    }
    return result;
}

int @P@_exact(const double world_T_tool[12], const @P@_conditions *conditions, const double near[N],
              double q[N], double *base_T_target, double *remaining)
{
    double F[12], real[12], r[6], back[6], size = HUGE_VAL, before;
    int result, round, k, quick = 1;
    multiply(BASE_T_WORLD, world_T_tool, F);
    result = @P@_nominal_inverse(F, near, q);
    for (round = 0; result == @P@_OK; ++round) {
        @P@_forward(q, conditions, real);
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
            result = @P@_NOT_CONVERGED;
            break;
        }
        /* joint steps while they gain much; near singularities the closed form of the corrected target */
        quick = quick && size < 0.25 * before;
        if (!(quick && step(back, q))) {
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
"""
