/* Closed-form inverse of an arm whose axes 2, 3, 4 are parallel. */
#pragma once
#include "to_plane.h"

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
            double c5 = cos(t5[j]), s5 = sin(t5[j]), before[3], x[3], y[3], t6, moved[2][3], ahead[3], t3[2];
            double reach[3], arm4[3], v[3];
            rotate_cs(AXIS[FIRST + 4], c5, -s5, n, before);
            cross(AXIS[FIRST + 5], before, x);
            t6 = dot(x, x) < 1e-18 ? near[FIRST + 5] : angle_between(AXIS[FIRST + 5], behind, before);
            for (m = 0; m < 2; ++m) {
                for (k = 0; k < 3; ++k) {
                    x[k] = POINT[FIRST + 3][k] + (m ? PROBE[k] : 0.0);
                }
                move_cs(FIRST + 4, c5, -s5, x, y);
                move_cs(FIRST + 5, cos(t6), -sin(t6), y, x);
                turn(D, x, y);
                y[0] += D[3];
                y[1] += D[7];
                y[2] += D[11];
                move_cs(FIRST, c1, s1, y, moved[m]);
            }
            subtract(moved[1], moved[0], ahead);
            subtract(moved[0], POINT[FIRST + 1], reach);
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
