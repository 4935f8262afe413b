/* Nominal forward kinematics by joint lines. */
#pragma once
#include LINE_ANGLES

/* Nominal frame of the tool in base coordinates; with J also its right twist per joint (column i at J + 6 * i). */
static void chain(const double *q, double *T, double *J)
{
    double R[12] = {1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0}, axes[LINES][3], points[LINES][3];
    double angles[LINES], twists[6 * LINES];
    const double *u = line_angles(q, angles);
    int i, k;
    for (i = 0; i < LINES; ++i) {
        double E[12], C[12], image[3];
        turn(R, AXIS[i], axes[i]);
        turn(R, POINT[i], points[i]);
        points[i][0] += R[3];
        points[i][1] += R[7];
        points[i][2] += R[11];
        if (SLIDES[i]) {
            for (k = 0; k < 3; ++k) {
                R[4 * k + 3] += u[i] * axes[i][k];
            }
            continue;
        }
        {
            /* Rodrigues */
            double c = cos(u[i]), s = sin(u[i]), v = 1.0 - c;
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
    for (i = 0; i < LINES; ++i) {
        double arm[3], rho[3], omega[3] = {0.0, 0.0, 0.0};
        if (SLIDES[i]) {
            memcpy(rho, axes[i], sizeof rho);
        } else {
            arm[0] = T[3] - points[i][0];
            arm[1] = T[7] - points[i][1];
            arm[2] = T[11] - points[i][2];
            cross(axes[i], arm, rho);
            memcpy(omega, axes[i], sizeof omega);
        }
        for (k = 0; k < 3; ++k) {
            twists[6 * i + k] = T[k] * rho[0] + T[4 + k] * rho[1] + T[8 + k] * rho[2];
            twists[6 * i + 3 + k] = T[k] * omega[0] + T[4 + k] * omega[1] + T[8 + k] * omega[2];
        }
    }
    joint_twists(q, twists, J);
}
