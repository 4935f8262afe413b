"""The fixed parts of exported C for the nominal inverse in closed form.

The mathematics is that of :mod:`robcal.robot.subproblems` and :mod:`robcal.robot.inverse_analytic`; conventions as in
:mod:`robcal.robot.export.c_templates`.
"""

SUBPROBLEMS = r"""
/* Rodrigues: u turned about w */
static void rotate_cs(const double *w, double c, double s, const double *u, double *v)
{
    double d = dot(w, u) * (1.0 - c), x[3];
    cross(w, u, x);
    v[0] = c * u[0] + s * x[0] + d * w[0];
    v[1] = c * u[1] + s * x[1] + d * w[1];
    v[2] = c * u[2] + s * x[2] + d * w[2];
}

static void subtract(const double *a, const double *b, double *c)
{
    c[0] = a[0] - b[0];
    c[1] = a[1] - b[1];
    c[2] = a[2] - b[2];
}

static double clipped_acos(double x, int *possible)
{
    if (!(fabs(x) <= 1.0 + EDGE)) {
        *possible = 0;
        return 0.0;
    }
    return acos(x > 1.0 ? 1.0 : (x < -1.0 ? -1.0 : x));
}

/* angle about w from u to v */
static double angle_between(const double *w, const double *u, const double *v)
{
    double x[3];
    cross(u, v, x);
    return atan2(dot(w, x), dot(u, v) - dot(w, u) * dot(w, v));
}

/* |v - rot(w, t) u|^2 = d2 */
static int to_distance(const double *w, const double *u, const double *v, double d2, double *t)
{
    double along = dot(w, u) - dot(w, v), uu = dot(u, u) - dot(w, u) * dot(w, u);
    double vv = dot(v, v) - dot(w, v) * dot(w, v), middle = angle_between(w, u, v), half;
    int possible = 1;
    half = clipped_acos((uu + vv - d2 + along * along) / (2.0 * sqrt(uu * vv)), &possible);
    t[0] = middle + half;
    t[1] = middle - half;
    return possible;
}
"""

TO_PLANE = r"""
/* n . rot(w, t) u = h */
static int to_plane(const double *w, const double *u, const double *n, double h, double *t)
{
    double x[3], a = dot(n, u) - dot(w, u) * dot(w, n), b, middle, half;
    int possible = 1;
    cross(w, u, x);
    b = dot(n, x);
    middle = atan2(b, a);
    half = clipped_acos((h - dot(w, u) * dot(n, w)) / hypot(a, b), &possible);
    t[0] = middle + half;
    t[1] = middle - half;
    return possible;
}
"""

TWO_TURNS = r"""
/* rot(w1, t1) rot(w2, t2) u = v; returns 0 if impossible */
static int two_turns(const double *w1, const double *w2, const double *u, const double *v, double *t1, double *t2)
{
    double c = dot(w1, w2), a = dot(w1, v), b = dot(w2, u), s2 = 1.0 - c * c, uu = dot(u, u), x[3], z[3];
    double alpha = (a - c * b) / s2, beta = (b - c * a) / s2;
    double gamma2 = (uu - alpha * alpha - beta * beta - 2.0 * alpha * beta * c) / s2, gamma;
    int k, i;
    if (!(gamma2 >= -EDGE * uu / s2)) {
        return 0;
    }
    gamma = gamma2 > 0.0 ? sqrt(gamma2) : 0.0;
    cross(w1, w2, x);
    for (k = 0; k < 2; ++k) {
        double g = k ? -gamma : gamma;
        for (i = 0; i < 3; ++i) {
            z[i] = alpha * w1[i] + beta * w2[i] + g * x[i];
        }
        t2[k] = angle_between(w2, u, z);
        t1[k] = angle_between(w1, z, v);
    }
    return 1;
}
"""

SPHERICAL_WRIST = r"""
/* Branches of an arm whose last three axes meet in CENTRE; D = base_T_tool HOME^-1. Returns their number. */
static int closed_form(const double *D, const double *near, double branch[8][N])
{
    double goal[3], arm[4][3], pointing0[3], probe0[3];
    int count = 0, arms, b, k, i;
    turn(D, CENTRE, goal);
    goal[0] += D[3];
    goal[1] += D[7];
    goal[2] += D[11];
    arms = arm_angles(goal, arm);
    turn(D, AXIS[FIRST + 5], pointing0);
    turn(D, PROBE, probe0);
    for (b = 0; b < arms; ++b) {
        double t4[2], t5[2], pointing[3], probe[3], x[3];
        int wrists = 2;
        memcpy(pointing, pointing0, sizeof pointing);
        memcpy(probe, probe0, sizeof probe);
        for (i = 0; i < 3; ++i) {
            double c = cos(arm[b][i]), s = -sin(arm[b][i]);
            rotate_cs(AXIS[FIRST + i], c, s, pointing, x);
            memcpy(pointing, x, sizeof x);
            rotate_cs(AXIS[FIRST + i], c, s, probe, x);
            memcpy(probe, x, sizeof x);
        }
        cross(AXIS[FIRST + 3], pointing, x);
        if (dot(x, x) < 1e-18) {
            /* axes 4 and 6 aligned: axis 4 stays where it is */
            double kept[3];
            wrists = 1;
            t4[0] = near[FIRST + 3];
            rotate_cs(AXIS[FIRST + 3], cos(t4[0]), -sin(t4[0]), pointing, kept);
            t5[0] = angle_between(AXIS[FIRST + 4], AXIS[FIRST + 5], kept);
        } else if (!two_turns(AXIS[FIRST + 3], AXIS[FIRST + 4], AXIS[FIRST + 5], pointing, t4, t5)) {
            continue;
        }
        for (k = 0; k < wrists; ++k) {
            double y[3], z[3];
            double *q = branch[count++];
            rotate_cs(AXIS[FIRST + 3], cos(t4[k]), -sin(t4[k]), probe, y);
            rotate_cs(AXIS[FIRST + 4], cos(t5[k]), -sin(t5[k]), y, z);
            for (i = 0; i < FIRST; ++i) {
                q[i] = near[i];
            }
            q[FIRST] = arm[b][0];
            q[FIRST + 1] = arm[b][1];
            q[FIRST + 2] = arm[b][2];
            q[FIRST + 3] = t4[k];
            q[FIRST + 4] = t5[k];
            q[FIRST + 5] = angle_between(AXIS[FIRST + 5], PROBE, z);
        }
    }
    return count;
}
"""

ARM_PARALLEL_23 = r"""
/* Axes 2 and 3 parallel: heights along them are axis 1's, the rest is a triangle. */
static int arm_angles(const double *goal, double arm[4][3])
{
    double u[3], c3[3], v[3], t[2], rest[3];
    int count = 0, i, k;
    subtract(goal, POINT[FIRST], u);
    subtract(CENTRE, POINT[FIRST], rest);
    subtract(CENTRE, POINT[FIRST + 2], c3);
    subtract(POINT[FIRST + 1], POINT[FIRST + 2], v);
    if (!to_plane(AXIS[FIRST], u, AXIS[FIRST + 1], dot(AXIS[FIRST + 1], rest), t)) {
        return 0;
    }
    for (i = 0; i < 2; ++i) {
        double seen[3], reach[3], t3[2];
        rotate_cs(AXIS[FIRST], cos(t[i]), sin(t[i]), u, seen);
        for (k = 0; k < 3; ++k) {
            reach[k] = POINT[FIRST][k] + seen[k] - POINT[FIRST + 1][k];
        }
        if (!to_distance(AXIS[FIRST + 2], c3, v, dot(reach, reach), t3)) {
            continue;
        }
        for (k = 0; k < 2; ++k) {
            double placed[3];
            rotate_cs(AXIS[FIRST + 2], cos(t3[k]), sin(t3[k]), c3, placed);
            subtract(placed, v, placed);
            arm[count][0] = -t[i];
            arm[count][1] = angle_between(AXIS[FIRST + 1], placed, reach);
            arm[count][2] = t3[k];
            ++count;
        }
    }
    return count;
}
"""

ARM_MEETING_12 = r"""
/* Axes 1 and 2 meet in SHOULDER: axis 3 makes the distance, the rest is two turns. */
static int arm_angles(const double *goal, double arm[4][3])
{
    double c3[3], v[3], reach[3], t3[2];
    int count = 0, i, k;
    subtract(CENTRE, POINT[FIRST + 2], c3);
    subtract(SHOULDER, POINT[FIRST + 2], v);
    subtract(goal, SHOULDER, reach);
    if (!to_distance(AXIS[FIRST + 2], c3, v, dot(reach, reach), t3)) {
        return 0;
    }
    for (i = 0; i < 2; ++i) {
        double placed[3], t1[2], t2[2];
        rotate_cs(AXIS[FIRST + 2], cos(t3[i]), sin(t3[i]), c3, placed);
        subtract(placed, v, placed);
        if (!two_turns(AXIS[FIRST], AXIS[FIRST + 1], placed, reach, t1, t2)) {
            continue;
        }
        for (k = 0; k < 2; ++k) {
            arm[count][0] = t1[k];
            arm[count][1] = t2[k];
            arm[count][2] = t3[i];
            ++count;
        }
    }
    return count;
}
"""

ARM_PARALLEL_12 = r"""
/* Axes 1 and 2 parallel: heights along them are axis 3's, the rest is a triangle. */
static int arm_angles(const double *goal, double arm[4][3])
{
    double c3[3], lift[3], reach[3], v[3], t3[2];
    int count = 0, i, k;
    subtract(CENTRE, POINT[FIRST + 2], c3);
    subtract(goal, POINT[FIRST + 2], lift);
    subtract(goal, POINT[FIRST], reach);
    subtract(POINT[FIRST], POINT[FIRST + 1], v);
    if (!to_plane(AXIS[FIRST + 2], c3, AXIS[FIRST], dot(AXIS[FIRST], lift), t3)) {
        return 0;
    }
    for (i = 0; i < 2; ++i) {
        double placed[3], t2[2];
        rotate_cs(AXIS[FIRST + 2], cos(t3[i]), sin(t3[i]), c3, placed);
        for (k = 0; k < 3; ++k) {
            placed[k] += POINT[FIRST + 2][k] - POINT[FIRST + 1][k];
        }
        if (!to_distance(AXIS[FIRST + 1], placed, v, dot(reach, reach), t2)) {
            continue;
        }
        for (k = 0; k < 2; ++k) {
            double elbow[3];
            rotate_cs(AXIS[FIRST + 1], cos(t2[k]), sin(t2[k]), placed, elbow);
            subtract(elbow, v, elbow);
            arm[count][0] = angle_between(AXIS[FIRST], elbow, reach);
            arm[count][1] = t2[k];
            arm[count][2] = t3[i];
            ++count;
        }
    }
    return count;
}
"""

PARALLEL_ARM = r"""
/* p moved by joint i's line */
static void move_cs(int i, double c, double s, const double *p, double *out)
{
    double u[3];
    subtract(p, POINT[i], u);
    rotate_cs(AXIS[i], c, s, u, out);
    out[0] += POINT[i][0];
    out[1] += POINT[i][1];
    out[2] += POINT[i][2];
}

/* Branches of an arm whose axes 2, 3, 4 are parallel and whose axes 5, 6 meet in CENTRE. */
static int closed_form(const double *D, const double *near, double branch[8][N])
{
    const double *n = AXIS[FIRST + 1];
    double goal[3], u[3], rest[3], t[2], pointing0[3];
    int count = 0, i, j, k, m;
    turn(D, CENTRE, goal);
    for (k = 0; k < 3; ++k) {
        u[k] = goal[k] + D[4 * k + 3] - POINT[FIRST][k];
    }
    subtract(CENTRE, POINT[FIRST], rest);
    if (!to_plane(AXIS[FIRST], u, n, dot(n, rest), t)) {
        return 0;
    }
    turn(D, AXIS[FIRST + 5], pointing0);
    for (i = 0; i < 2; ++i) {
        double pointing[3], t5[2], turned[3], behind[3], c1 = cos(t[i]), s1 = sin(t[i]);
        rotate_cs(AXIS[FIRST], c1, s1, pointing0, pointing);
        if (!to_plane(AXIS[FIRST + 4], AXIS[FIRST + 5], n, dot(n, pointing), t5)) {
            continue;
        }
        rotate_cs(AXIS[FIRST], c1, -s1, n, turned);
        for (k = 0; k < 3; ++k) {
            behind[k] = D[k] * turned[0] + D[4 + k] * turned[1] + D[8 + k] * turned[2];
        }
        for (j = 0; j < 2; ++j) {
            double c5 = cos(t5[j]), s5 = sin(t5[j]), before[3], x[3], y[3], t6, carried[3], ahead[3], t3[2];
            double reach[3], arm4[3], v[3];
            rotate_cs(AXIS[FIRST + 4], c5, -s5, n, before);
            cross(AXIS[FIRST + 5], before, x);
            t6 = dot(x, x) < 1e-18 ? near[FIRST + 5] : angle_between(AXIS[FIRST + 5], behind, before);
            for (m = 0; m < 2; ++m) {
                double *out = m ? ahead : carried;
                for (k = 0; k < 3; ++k) {
                    x[k] = POINT[FIRST + 3][k] + (m ? PROBE[k] : 0.0);
                }
                move_cs(FIRST + 4, c5, -s5, x, y);
                move_cs(FIRST + 5, cos(t6), -sin(t6), y, x);
                turn(D, x, y);
                y[0] += D[3];
                y[1] += D[7];
                y[2] += D[11];
                move_cs(FIRST, c1, s1, y, out);
            }
            subtract(ahead, carried, ahead);
            subtract(carried, POINT[FIRST + 1], reach);
            subtract(POINT[FIRST + 3], POINT[FIRST + 2], arm4);
            subtract(POINT[FIRST + 1], POINT[FIRST + 2], v);
            if (!to_distance(AXIS[FIRST + 2], arm4, v, dot(reach, reach), t3)) {
                continue;
            }
            for (m = 0; m < 2; ++m) {
                double placed[3], t2;
                double *q = branch[count++];
                rotate_cs(AXIS[FIRST + 2], cos(t3[m]), sin(t3[m]), arm4, placed);
                subtract(placed, v, placed);
                t2 = angle_between(n, placed, reach);
                rotate_cs(n, cos(t2), -sin(t2), ahead, x);
                rotate_cs(AXIS[FIRST + 2], cos(t3[m]), -sin(t3[m]), x, y);
                for (k = 0; k < FIRST; ++k) {
                    q[k] = near[k];
                }
                q[FIRST] = -t[i];
                q[FIRST + 1] = t2;
                q[FIRST + 2] = t3[m];
                q[FIRST + 3] = angle_between(AXIS[FIRST + 3], PROBE, y);
                q[FIRST + 4] = t5[j];
                q[FIRST + 5] = t6;
            }
        }
    }
    return count;
}
"""

CLOSED_INVERSE = r"""
int @P@_nominal_inverse(const double base_T_tool[12], const double near[N], double q[N])
{
    double shifted[12], D[12], branch[8][N], start[N], T[12], r[6], best = HUGE_VAL;
    int count, b, i, chosen = -1;
    memcpy(start, near, sizeof start);
    memcpy(q, near, sizeof start);
    memcpy(shifted, base_T_tool, sizeof shifted);
#if FIRST
    /* a track under the arm stays where it is */
    for (i = 0; i < 3; ++i) {
        shifted[4 * i + 3] -= near[0] * AXIS[0][i];
    }
#endif
    multiply(shifted, HOME_INVERSE, D);
    count = closed_form(D, start, branch);
    for (b = 0; b < count; ++b) {
        double distance = 0.0;
        if (!turn_near(branch[b], start)) {
            continue;
        }
        for (i = 0; i < N; ++i) {
            distance += (branch[b][i] - start[i]) * (branch[b][i] - start[i]);
        }
        if (distance < best) {
            best = distance;
            chosen = b;
        }
    }
    if (chosen < 0) {
        return count ? @P@_BEYOND_LIMITS : @P@_OUT_OF_REACH;
    }
    memcpy(q, branch[chosen], sizeof start);
    chain(q, T, 0);
    difference(T, base_T_tool, r);
    if (weighted(r) > 1e-22 && !refine(base_T_tool, q, 12)) {
        return @P@_OUT_OF_REACH;
    }
    return @P@_OK;
}
"""
