"""The fixed parts of exported C: header, vectors, chain. (The inverse and the commands have their own modules.)

Plain C99 with ``math.h`` alone. ``@P@`` is the prefix of all names. The mathematics is that of
:mod:`robcal.robot.chain`; frames are 3 x 4 matrices, row by row.
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
    double covariate[@COVARIATE_SIZE@]; /* in the order given above; see the default below */
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
        double E[12], C[12], image[3];
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
            /* Rodrigues */
            double c = cos(q[i]), s = sin(q[i]), v = 1.0 - c;
            const double *w = AXIS[i];
            E[0] = c + v * w[0] * w[0];
            E[1] = v * w[0] * w[1] - s * w[2];
            E[2] = v * w[0] * w[2] + s * w[1];
            E[4] = v * w[0] * w[1] + s * w[2];
            E[5] = c + v * w[1] * w[1];
            E[6] = v * w[1] * w[2] - s * w[0];
            E[8] = v * w[0] * w[2] - s * w[1];
            E[9] = v * w[1] * w[2] + s * w[0];
            E[10] = c + v * w[2] * w[2];
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
