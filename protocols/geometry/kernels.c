/* Inner loops of splines and of pair synchronisation: what numpy does in hundreds of small calls.

Each function does what the numpy code does that calls it, which stays the fallback and the reference of the tests.
Arrays are C-contiguous doubles, coordinate by coordinate, rows last. No fast-math, no fused operations: the same
numbers on every machine. */

#include <math.h>
#include <stdint.h>
#include <string.h>

typedef int64_t integer;

#define SIXTH (1.0 / 6.0)

enum { BLOCK = 64, MOST_COLUMNS = 9 };

/* On processors with wider registers a loop takes fewer operations, with the same result. */
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && defined(__linux__)
#define WIDE __attribute__((target_clones("avx2", "default")))
#define INLINE inline __attribute__((always_inline))
#else
#define WIDE
#define INLINE inline
#endif

/* hub.trajectory.splines.SplineBasis.locate for one time; 0 outside. basis: (4, stretches) starts, widths, intervals,
   first control points. hint: the stretch of the time before. */
static int locate(const double *basis, integer stretches, double time, double extrapolation, integer *hint,
                  integer *index, double *u, double *width)
{
    const double *starts = basis, *widths = basis + stretches;
    integer k = *hint;
    int inside = 1;
    if (!isfinite(time)) {
        time = starts[0];
        inside = 0;
    }
    while (k + 1 < stretches && starts[k + 1] - extrapolation * widths[k + 1] <= time) k++;
    while (k > 0 && starts[k] - extrapolation * widths[k] > time) k--;
    *hint = k;
    if (starts[k] - extrapolation * widths[k] > time) inside = 0;
    double count = basis[2 * stretches + k], place = (time - starts[k]) / widths[k];
    if (place > count + extrapolation + 1e-9) inside = 0;
    double low = place < 0.0 ? 0.0 : place;
    integer interval = (integer)(low < count - 1.0 ? low : count - 1.0);
    *index = (integer)basis[3 * stretches + k] + interval;
    *u = place - (double)interval;
    *width = widths[k];
    return inside;
}

/* Rows from begin to end of n. */
static INLINE void weights_of_rows(integer begin, integer end, integer n, const double *time, integer stretches,
                                   const double *basis, integer first, double extrapolation, integer *index,
                                   double *weights, double *slopes, uint8_t *inside)
{
    integer hint = 0;
    for (integer i = begin; i < end; i++) {
        double u, width;
        inside[i] = (uint8_t)locate(basis, stretches, time[i], extrapolation, &hint, index + i, &u, &width);
        index[i] += first;
        double v = 1.0 - u, square = u * u, cube = square * u;
        weights[i] = v * v * v * SIXTH;
        weights[n + i] = (3 * cube - 6 * square + 4) * SIXTH;
        weights[2 * n + i] = (-3 * cube + 3 * square + 3 * u + 1) * SIXTH;
        weights[3 * n + i] = cube * SIXTH;
        if (!slopes) continue;
        double over = SIXTH / width;
        slopes[i] = -3 * v * v * over;
        slopes[n + i] = (9 * square - 12 * u) * over;
        slopes[2 * n + i] = (-9 * square + 6 * u + 3) * over;
        slopes[3 * n + i] = 3 * square * over;
    }
}

/* SplineBasis.weights_and_derivatives: index (n,), weights and, unless null, slopes (4, n), inside (n,). */
void spline_weights(integer n, const double *time, integer stretches, const double *basis, double extrapolation,
                    integer *index, double *weights, double *slopes, uint8_t *inside)
{
    weights_of_rows(0, n, n, time, stretches, basis, 0, extrapolation, index, weights, slopes, inside);
}

/* The same for several labels, whose rows end at ends. tables: of each its basis, the stretches of it and the first
   control point. */
void label_weights(integer n, const double *time, integer labels, const integer *ends, const integer *tables,
                   double extrapolation, integer *index, double *weights, double *slopes, uint8_t *inside)
{
    for (integer k = 0, begin = 0; k < labels; begin = ends[k++], tables += 3)
        weights_of_rows(begin, ends[k], n, time, tables[1], (const double *)tables[0], tables[2], extrapolation, index,
                        weights, slopes, inside);
}

/* SplineBasis.evaluate_with_derivatives: polynomials (4, d, m); values, slopes (d, n). */
void spline_values(integer n, const double *time, integer stretches, const double *basis, integer d, integer m,
                   const double *polynomials, double *values, double *slopes)
{
    integer hint = 0, index;
    double u, width;
    for (integer i = 0; i < n; i++) {
        int inside = locate(basis, stretches, time[i], 0.0, &hint, &index, &u, &width);
        for (integer axis = 0; axis < d; axis++) {
            const double *p = polynomials + axis * m + index;
            double slope = p[3 * d * m] * u, value = slope + p[2 * d * m];
            slope += value;
            value = value * u + p[d * m];
            slope = slope * u + value;
            values[axis * n + i] = inside ? value * u + p[0] : NAN;
            slopes[axis * n + i] = inside ? slope / width : NAN;
        }
    }
}

/* hub.trajectory.splines.weighted_sums: control (size, d), weights (4, n); out (d, n). */
void weighted_sums(integer n, integer d, const double *control, const integer *index, const double *weights,
                   double *out)
{
    for (integer i = 0; i < n; i++) {
        const double *p = control + d * index[i];
        for (integer axis = 0; axis < d; axis++)
            out[axis * n + i] = weights[i] * p[axis] + weights[n + i] * p[d + axis] + weights[2 * n + i] * p[2 * d + axis]
                                + weights[3 * n + i] * p[3 * d + axis];
    }
}

/* The normal equations of hub.trajectory.splines.fit_spline: weights (4, n), values (n, d); bands (4, size) and target
   (d, size), both zero before. */
void spline_normal(integer n, const integer *index, const double *weights, const double *row_weight, integer d,
                   const double *values, integer stretches, const double *basis, double stiffness, integer size,
                   double *bands, double *target)
{
    static const double third[4] = {-1.0, 3.0, -3.0, 1.0};
    for (integer i = 0; i < n; i++) {
        if (row_weight[i] == 0.0) continue;
        for (int a = 0; a < 4; a++) {
            double used = row_weight[i] * weights[a * n + i];
            integer row = index[i] + a;
            for (int b = a; b < 4; b++) bands[(3 - b + a) * size + index[i] + b] += used * weights[b * n + i];
            for (integer axis = 0; axis < d; axis++) target[axis * size + row] += used * values[d * i + axis];
        }
    }
    for (integer s = 0; s < stretches; s++) {
        integer first = (integer)basis[3 * stretches + s], last = first + (integer)basis[2 * stretches + s];
        for (integer j = first; j < last; j++)
            for (int a = 0; a < 4; a++)
                for (int b = a; b < 4; b++) bands[(3 - b + a) * size + j + b] += stiffness * third[a] * third[b];
    }
    for (integer j = 0; j < size; j++) bands[3 * size + j] += 1e-12;
}

/* hub.bundle.bordered_system.add_rows: index (n,), weights (4, n), terms (2, 3 + p, n), p at most 21, of several labels
   whose rows end at ends. tables: of each its first control point and sums ((size + 4) * 10, 6), and the first one
   observed and crossed (k, 3, p) from there, to which it is added. All are added to gram (p, p). */
WIDE void add_rows(integer labels, const integer *tables, const integer *ends, const integer *index,
                   const double *weights, integer p, const double *terms, double *gram)
{
    enum { MOST = 24 };
    const integer width = 3 + p, n = labels ? ends[labels - 1] : 0;
    for (integer k = 0, i = 0; k < labels; k++, tables += 4) {
        double *sums = (double *)tables[1], *crossed = (double *)tables[3], own[(MOST - 3) * (MOST - 3)] = {0.0};
        for (; i < ends[k]; i++) {
            double u[MOST], v[MOST], products[3][MOST];
            const integer seen = index[i] - tables[2];
            for (integer c = 0; c < width; c++) {
                u[c] = terms[c * n + i];
                v[c] = terms[(width + c) * n + i];
            }
            for (int r = 0; r < 3; r++)
                for (integer c = 0; c < width; c++) products[r][c] = u[r] * u[c] + v[r] * v[c];
            double upper[6] = {products[0][0], products[0][1], products[0][2],
                               products[1][1], products[1][2], products[2][2]};
            double *of_pair = sums + 60 * (index[i] - tables[0]);
            for (int a = 0; a < 4; a++) {
                double weight = weights[a * n + i], *to = crossed + (seen + a) * 3 * p;
                for (int r = 0; r < 3; r++)
                    for (integer c = 0; c < p; c++) to[r * p + c] += weight * products[r][3 + c];
                for (int b = a; b < 4; b++, of_pair += 6) {
                    double both = weight * weights[b * n + i];
                    for (int j = 0; j < 6; j++) of_pair[j] += both * upper[j];
                }
            }
            for (integer r = 0; r < p; r++)
                for (integer c = 0; c < p; c++) own[r * p + c] += u[3 + r] * u[3 + c] + v[3 + r] * v[3 + c];
        }
        for (integer j = 0; j < p * p; j++) gram[j] += own[j];
    }
}

/* Intrinsics.distort: normalised (2, n), coefficients k1, k2, p1, p2, k3; out (2, n), jacobian (2, 2, n). */
WIDE void brown_distortion(integer n, const double *normalised, const double *coefficients, double *out,
                           double *jacobian)
{
    const double k1 = coefficients[0], k2 = coefficients[1], p1 = coefficients[2], p2 = coefficients[3];
    const double k3 = coefficients[4];
    for (integer i = 0; i < n; i++) {
        double x = normalised[i], y = normalised[n + i], r2 = x * x + y * y;
        double radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)), slope = k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2);
        double mixed = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y;
        out[i] = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
        out[n + i] = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y;
        jacobian[i] = radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x;
        jacobian[n + i] = jacobian[2 * n + i] = mixed;
        jacobian[3 * n + i] = radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x;
    }
}

/* Intrinsics.project and hub.bundle.residuals.evaluate_points: pixels (2, n) of world points (3, n) by a pinhole with
   Brown's distortion; their camera_points (3, n), normalised (2, n), the Jacobian (2, 2, n) of distorted by normalised
   coordinates. valid: (n,) where to look at all; on return also in front and within the fold. Elsewhere normalised = 0. */
WIDE void project_points(integer n, const double *points, const double *rotation, const double *position,
                         const double *matrix, const double *coefficients, double fold, double *camera_points,
                         double *normalised, double *pixels, double *jacobian, uint8_t *valid)
{
    const double *r = rotation, *m = matrix;
    double *px = pixels, *py = pixels + n;
    for (integer i = 0; i < n; i++) {
        double dx = points[i] - position[0], dy = points[n + i] - position[1], dz = points[2 * n + i] - position[2];
        double cx = r[0] * dx + r[1] * dy + r[2] * dz, cy = r[3] * dx + r[4] * dy + r[5] * dz;
        double cz = r[6] * dx + r[7] * dy + r[8] * dz, x = cx / cz, y = cy / cz;
        int seen = (valid[i] != 0) & (cz > 0.0) & (x * x + y * y < fold * fold);
        camera_points[i] = cx;
        camera_points[n + i] = cy;
        camera_points[2 * n + i] = cz;
        normalised[i] = seen ? x : 0.0;
        normalised[n + i] = seen ? y : 0.0;
        valid[i] = (uint8_t)seen;
    }
    brown_distortion(n, normalised, coefficients, pixels, jacobian);
    for (integer i = 0; i < n; i++) {
        double x = px[i], y = py[i];
        px[i] = m[0] * x + m[1] * y + m[2];
        py[i] = m[3] * x + m[4] * y + m[5];
    }
}

/* hub.bundle.residuals.jacobians: out (2, columns, n), by the point first; those of pose parameter k in column place[k],
   unless negative. By time (2, n), from velocity (3, n), unless null. */
WIDE void pose_jacobians(integer n, const double *rotation, const double *matrix, const double *camera_points,
                         const double *normalised, const double *distortion, const uint8_t *valid,
                         const double *velocity, const integer *place, integer columns, double *by_time, double *out)
{
    const double *r = rotation;
    for (integer start = 0; start < n; start += BLOCK) {
        const integer count = n - start < BLOCK ? n - start : BLOCK;
        const double *at = camera_points + start, *flat = normalised + start, *bent = distortion + start;
        for (integer row = 0; row < 2; row++) {
            double by[3][BLOCK], *to = out + row * columns * n + start;
            const double a = matrix[3 * row], b = matrix[3 * row + 1];
            for (integer i = 0; i < count; i++) {
                double near = 1.0 / (valid[start + i] ? at[2 * n + i] : 1.0);
                by[0][i] = (a * bent[i] + b * bent[2 * n + i]) * near;
                by[1][i] = (a * bent[n + i] + b * bent[3 * n + i]) * near;
                by[2][i] = -by[0][i] * flat[i] - by[1][i] * flat[n + i];
            }
            for (integer k = 0; k < 3; k++) {
                double *point = to + k * n;
                for (integer i = 0; i < count; i++)
                    point[i] = r[k] * by[0][i] + r[3 + k] * by[1][i] + r[6 + k] * by[2][i];
            }
            for (integer k = 0; k < 3; k++) {
                const integer p = (k + 1) % 3, q = (k + 2) % 3;
                double *turned = to + place[k] * n, *moved = to + place[3 + k] * n;
                if (place[k] >= 0)  /* a rotation by w moves the point by w x camera_points */
                    for (integer i = 0; i < count; i++) turned[i] = at[p * n + i] * by[q][i] - at[q * n + i] * by[p][i];
                if (place[3 + k] >= 0)
                    for (integer i = 0; i < count; i++) moved[i] = -to[k * n + i];
            }
            if (velocity) {
                const double *v = velocity + start;
                double *time = by_time + row * n + start;
                for (integer i = 0; i < count; i++)
                    time[i] = to[i] * v[i] + to[n + i] * v[n + i] + to[2 * n + i] * v[2 * n + i];
            }
        }
    }
}

/* The tracks of one camera, a label each. rows: where each label's rows end. */
typedef struct {
    integer labels;
    const integer *ends, *stretches, *sizes;
    const double *const *bases, *const *polynomials;
} tracks_t;

/* hub.two_view.refinement: normal (k + 2, k + 2), gradient (k + 2,) and cost of Sampson distances with Cauchy weights,
   at the time map t_b = inverse_rate * centred_time + intercept. points: (2, n) of a; tracks: of b, whose polynomials
   are (4, 2, size). tangents: (k, 3, 3) derivatives of the matrix (3, 3). Returns the number of rows where b is. */
WIDE static integer sampson_system(integer n, const double *points, const double *centred_time, const tracks_t *tracks,
                       double inverse_rate, double intercept, const double *matrix, const double *tangents,
                       integer k, double variance_a, double variance_b, double width, double *normal,
                       double *gradient, double *cost)
{
    const double *m = matrix;
    const integer columns = k + 2;
    double sums[MOST_COLUMNS][MOST_COLUMNS + 1] = {{0.0}}, total = 0.0;
    integer count = 0, label = 0, hint = 0, i = 0;
    while (i < n) {
        double ax[BLOCK], ay[BLOCK], bx[BLOCK], by[BLOCK], vx[BLOCK], vy[BLOCK], at[BLOCK], over[BLOCK], weight[BLOCK];
        double row[MOST_COLUMNS + 1][BLOCK] = {{0.0}};
        int many = 0;
        for (; i < n && many < BLOCK; i++) {
            while (i >= tracks->ends[label]) {
                label++;
                hint = 0;
            }
            integer index, size = tracks->sizes[label];
            double u, knot, time = inverse_rate * centred_time[i] + intercept;
            if (!locate(tracks->bases[label], tracks->stretches[label], time, 0.0, &hint, &index, &u, &knot)) continue;
            const double *p = tracks->polynomials[label] + index;
            double slope = p[6 * size] * u, value = slope + p[4 * size];
            slope += value;
            value = value * u + p[2 * size];
            vx[many] = (slope * u + value) / knot;
            bx[many] = value * u + p[0];
            p += size;
            slope = p[6 * size] * u, value = slope + p[4 * size];
            slope += value;
            value = value * u + p[2 * size];
            vy[many] = (slope * u + value) / knot;
            by[many] = value * u + p[0];
            ax[many] = points[i];
            ay[many] = points[n + i];
            at[many++] = centred_time[i];
        }
        for (int j = 0; j < many; j++) {
            double b0 = m[0] * ax[j] + m[1] * ay[j] + m[2], b1 = m[3] * ax[j] + m[4] * ay[j] + m[5];
            double b2 = m[6] * ax[j] + m[7] * ay[j] + m[8];
            double a0 = m[0] * bx[j] + m[3] * by[j] + m[6], a1 = m[1] * bx[j] + m[4] * by[j] + m[7];
            double variance = variance_b * (b0 * b0 + b1 * b1) + variance_a * (a0 * a0 + a1 * a1);
            over[j] = 1.0 / sqrt(variance > 1e-30 ? variance : 1e-30);
            double residual = (bx[j] * b0 + by[j] * b1 + b2) * over[j], ratio = residual / width;
            row[MOST_COLUMNS][j] = residual;
            row[k][j] = (b0 * vx[j] + b1 * vy[j]) * over[j];
            row[k + 1][j] = row[k][j] * at[j];
            weight[j] = ratio * ratio;
        }
        for (integer c = 0; c < k; c++) {
            const double *t = tangents + 9 * c;
            for (int j = 0; j < many; j++)
                row[c][j] = (bx[j] * (t[0] * ax[j] + t[1] * ay[j] + t[2]) + by[j] * (t[3] * ax[j] + t[4] * ay[j] + t[5])
                             + (t[6] * ax[j] + t[7] * ay[j] + t[8])) * over[j];
        }
        for (int j = 0; j < many; j++) {
            total += log1p(weight[j]);
            weight[j] = 1.0 / (1.0 + weight[j]);
        }
        for (int j = 0; j < many; j++) {
            double values[MOST_COLUMNS + 1];
            for (integer q = 0; q <= MOST_COLUMNS; q++) values[q] = row[q][j];
            for (integer p = 0; p < columns; p++) {
                double weighted = values[p] * weight[j];
                for (integer q = 0; q <= MOST_COLUMNS; q++) sums[p][q] += weighted * values[q];
            }
        }
        count += many;
    }
    for (integer p = 0; p < columns; p++) {
        for (integer q = 0; q < columns; q++) normal[p * columns + q] = sums[p][q];
        gradient[p] = sums[p][MOST_COLUMNS];
    }
    *cost = total * width * width;
    return count;
}

/* out = a b of (3, 3). */
static void multiply(const double *a, const double *b, double *out)
{
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) out[3 * i + j] = a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j];
}

/* out = hat(w) b. */
static void cross(const double *w, const double *b, double *out)
{
    const double hat[9] = {0.0, -w[2], w[1], w[2], 0.0, -w[0], -w[1], w[0], 0.0};
    multiply(hat, b, out);
}

/* hub.two_view.relative_pose.orthogonal_axes: axes (2, 3). */
static void orthogonal_axes(const double *d, double *axes)
{
    double x = d[0], y = d[1], z = d[2], p, q, r;
    if (fabs(x) <= fabs(y) && fabs(x) <= fabs(z)) p = 0.0, q = z, r = -y;
    else if (fabs(y) <= fabs(z)) p = -z, q = 0.0, r = x;
    else p = y, q = -x, r = 0.0;
    double length = sqrt(p * p + q * q + r * r);
    p /= length, q /= length, r /= length;
    const double both[6] = {p, q, r, y * r - z * q, z * p - x * r, x * q - y * p};
    memcpy(axes, both, sizeof both);
}

/* protocols.geometry.so3.exp of w. */
static void rotation_of(const double *w, double *out)
{
    double x = w[0], y = w[1], z = w[2], angle2 = x * x + y * y + z * z, angle = sqrt(angle2);
    double a = angle < 1e-4 ? 1.0 - angle2 / 6.0 : sin(angle) / angle;
    double b = angle < 1e-4 ? 0.5 - angle2 / 24.0 : (1.0 - cos(angle)) / angle2;
    double ax = a * x, ay = a * y, az = a * z, xy = b * x * y, xz = b * x * z, yz = b * y * z;
    const double exp[9] = {1.0 - b * (y * y + z * z), xy - az, xz + ay, xy + az, 1.0 - b * (x * x + z * z), yz - ax,
                           xz - ay, yz + ax, 1.0 - b * (x * x + y * y)};
    memcpy(out, exp, sizeof exp);
}

/* Gaussian elimination with partial pivoting of (n, n); the solution in right. 0 if singular. */
static int solve(integer n, double *matrix, double *right)
{
    for (integer k = 0; k < n; k++) {
        integer pivot = k;
        for (integer i = k + 1; i < n; i++)
            if (fabs(matrix[i * n + k]) > fabs(matrix[pivot * n + k])) pivot = i;
        if (matrix[pivot * n + k] == 0.0) return 0;
        for (integer j = 0; j < n && pivot != k; j++) {
            double other = matrix[k * n + j];
            matrix[k * n + j] = matrix[pivot * n + j];
            matrix[pivot * n + j] = other;
        }
        double other = right[k];
        right[k] = right[pivot];
        right[pivot] = other;
        for (integer i = k + 1; i < n; i++) {
            double factor = matrix[i * n + k] / matrix[k * n + k];
            for (integer j = k + 1; j < n; j++) matrix[i * n + j] -= factor * matrix[k * n + j];
            right[i] -= factor * right[k];
        }
    }
    for (integer k = n - 1; k >= 0; k--) {
        for (integer j = k + 1; j < n; j++) right[k] -= matrix[k * n + j] * right[j];
        right[k] /= matrix[k * n + k];
    }
    return 1;
}

/* A two-view geometry and a time map, as hub.two_view.refinement has them: of a relative pose left is the rotation and
   rest the direction; of a fundamental matrix rest is the angle. */
typedef struct {
    double left[9], right[9], rest[3], inverse_rate, intercept;
} alignment_t;

typedef struct {
    double normal[MOST_COLUMNS * MOST_COLUMNS], gradient[MOST_COLUMNS], cost;
} system_t;

typedef struct {
    integer n, columns, least, calibrated;
    const double *points, *centred_time;
    const tracks_t *tracks;
    double variance_a, variance_b, prior;
} samples_t;

/* left diag(first, second, 0) right. */
static void of_rank_two(const alignment_t *at, double first, double second, double *out)
{
    double scaled[9];
    for (int i = 0; i < 3; i++) {
        scaled[3 * i] = at->left[3 * i] * first;
        scaled[3 * i + 1] = at->left[3 * i + 1] * second;
        scaled[3 * i + 2] = 0.0;
    }
    multiply(scaled, at->right, out);
}

/* `matrix` (3, 3) and `tangents` (5 or 7, 3, 3) of hub.two_view.relative_pose. */
static void geometry_of(const alignment_t *at, integer calibrated, double *matrix, double *tangents)
{
    double axes[6], part[9];
    if (calibrated) cross(at->rest, at->left, matrix);
    else of_rank_two(at, cos(at->rest[0]), sin(at->rest[0]), matrix);
    for (int axis = 0; axis < 3; axis++) {
        const double unit[3] = {axis == 0, axis == 1, axis == 2};
        if (calibrated) {
            cross(unit, at->left, part);
            cross(at->rest, part, tangents + 9 * axis);
        } else {
            const double hat[9] = {0.0, -unit[2], unit[1], unit[2], 0.0, -unit[0], -unit[1], unit[0], 0.0};
            cross(unit, matrix, tangents + 9 * axis);
            multiply(matrix, hat, tangents + 27 + 9 * axis);
        }
    }
    if (calibrated) {
        orthogonal_axes(at->rest, axes);
        cross(axes, at->left, tangents + 27);
        cross(axes + 3, at->left, tangents + 36);
    } else {
        of_rank_two(at, -sin(at->rest[0]), cos(at->rest[0]), tangents + 54);
    }
}

/* `retract` of hub.two_view.relative_pose. */
static void retract(alignment_t *at, integer calibrated, const double *step)
{
    double turn[9], turned[9], axes[6], length = 0.0;
    rotation_of(step, turn);
    multiply(turn, at->left, turned);
    memcpy(at->left, turned, sizeof turned);
    if (!calibrated) {
        rotation_of(step + 3, turn);
        multiply(at->right, turn, turned);
        memcpy(at->right, turned, sizeof turned);
        at->rest[0] += step[6];
        return;
    }
    orthogonal_axes(at->rest, axes);
    for (int k = 0; k < 3; k++) at->rest[k] += step[3] * axes[k] + step[4] * axes[3 + k];
    for (int k = 0; k < 3; k++) length += at->rest[k] * at->rest[k];
    for (int k = 0; k < 3; k++) at->rest[k] /= sqrt(length);
}

static void alignment_system(const samples_t *samples, const alignment_t *at, double width, system_t *out)
{
    integer k = samples->columns - 2;
    double matrix[9], tangents[63];
    geometry_of(at, samples->calibrated, matrix, tangents);
    integer count = sampson_system(samples->n, samples->points, samples->centred_time, samples->tracks, at->inverse_rate,
                                   at->intercept, matrix, tangents, k, samples->variance_a, samples->variance_b, width,
                                   out->normal, out->gradient, &out->cost);
    double off = at->inverse_rate - 1.0;
    out->normal[samples->columns * samples->columns - 1] += samples->prior;
    out->gradient[samples->columns - 1] += samples->prior * off;
    out->cost = count < samples->least ? INFINITY : (out->cost + samples->prior * off * off) / (double)count;
}

/* hub.two_view.refinement.refine: state (23,) as alignment_t, in place; free: the geometry's parameters, 0 if it is
   given; normal (free + 2, free + 2). Returns the cost, infinite where there is none. */
double refine_alignment(integer n, const double *points, const double *centred_time, const tracks_t *tracks,
                        double *state, integer calibrated, integer free_count, double variance_a, double variance_b,
                        double prior, integer least, double width, double final_width, integer iterations,
                        double tolerance, double *normal)
{
    const integer columns = free_count + 2;
    samples_t samples = {n, columns, least, calibrated, points, centred_time, tracks, variance_a, variance_b, prior};
    alignment_t at, trial_at;
    system_t system, trial;
    double damping = 1e-3, last_gain = 0.0;
    memcpy(&at, state, sizeof at);
    alignment_system(&samples, &at, width, &system);
    if (!isfinite(system.cost)) return INFINITY;
    for (integer i = 0; i < iterations; i++) {
        double damped[MOST_COLUMNS * MOST_COLUMNS], step[MOST_COLUMNS];
        memcpy(damped, system.normal, sizeof damped);
        for (integer p = 0; p < columns; p++) {
            damped[p * (columns + 1)] += damping * system.normal[p * (columns + 1)] + 1e-12;
            step[p] = -system.gradient[p];
        }
        if (!solve(columns, damped, step)) return INFINITY;
        trial_at = at;
        trial_at.inverse_rate += step[columns - 1];
        trial_at.intercept += step[columns - 2];
        if (free_count) retract(&trial_at, calibrated, step);
        alignment_system(&samples, &trial_at, width, &trial);
        if (trial.cost < system.cost) {
            at = trial_at;
            damping = damping / 5.0 > 1e-9 ? damping / 5.0 : 1e-9;
            if (width == final_width) {
                double gain = system.cost - trial.cost, limit = tolerance * system.cost;
                system = trial;
                if (gain * gain / (gain > last_gain ? gain : last_gain) < limit) break;
                last_gain = gain;
                continue;
            }
        } else if (width == final_width) {
            damping *= 8.0;
            if (damping > 1e3) break;
            continue;
        }
        width = 0.5 * width > final_width ? 0.5 * width : final_width;
        alignment_system(&samples, &at, width, &system);
    }
    if (!(at.inverse_rate > 0.5 && at.inverse_rate < 2.0) || width > final_width) return INFINITY;
    memcpy(state, &at, sizeof at);
    memcpy(normal, system.normal, sizeof(double) * (size_t)(columns * columns));
    return system.cost;
}

#define LANES 8
#define FOR_LANES for (int lane = 0; lane < LANES; lane++)
typedef double lanes[LANES];

static const int monomial[3][3] = {{0, 1, 2}, {1, 3, 4}, {2, 4, 5}};

/* Taubin's normalisation times a vector of eight: noise_a, noise_b are of the six monomials. */
static INLINE void normalise(lanes *noise_a, lanes *noise_b, lanes *vector, lanes *out)
{
    for (int p = 0; p < 8; p++) FOR_LANES out[p][lane] = 0.0;
    for (int i = 0; i < 2; i++)
        for (int j = 0; j < 3; j++)
            for (int l = 0; l < 3; l++)
                FOR_LANES out[3 * i + j][lane] += noise_b[monomial[j][l]][lane] * vector[3 * i + l][lane];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 2; j++)
            for (int k = 0; k < 3; k++)
                FOR_LANES out[3 * i + j][lane] += noise_a[monomial[i][k]][lane] * vector[3 * k + j][lane];
}

static INLINE void ldl_solve(lanes (*factor)[8], lanes *right, lanes *out)
{
    memcpy(out, right, sizeof(lanes) * 8);
    for (int k = 0; k < 8; k++)
        for (int i = k + 1; i < 8; i++) FOR_LANES out[i][lane] -= factor[i][k][lane] * out[k][lane];
    for (int k = 0; k < 8; k++) FOR_LANES out[k][lane] /= factor[k][k][lane];
    for (int k = 7; k >= 0; k--)
        for (int i = 0; i < k; i++) FOR_LANES out[i][lane] -= factor[k][i][lane] * out[k][lane];
}

static INLINE void dot(lanes *a, lanes *b, lanes out)
{
    FOR_LANES out[lane] = 0.0;
    for (int p = 0; p < 8; p++) FOR_LANES out[lane] += a[p][lane] * b[p][lane];
}

static INLINE double at_least(double value, double least) { return value > least ? value : least; }

/* hub.sync.lag_scan.smallest_eigenvalues: moments (6, 6, m); out (m,). */
WIDE void smallest_eigenvalues(integer m, const double *moments, double variance_a, double variance_b, integer iterations,
                          double min_orthogonal, double *out)
{
    static const double start_phase = 1.7;
    double first[8];
    for (int p = 0; p < 8; p++) first[p] = cos(start_phase * (p + 1.0) * (p + 1.0));
    for (integer begin = 0; begin < m; begin += LANES) {
        lanes scaled[6][6], work[8][8], noise_a[6], noise_b[6], y[8], z[8], image[8], by_moment[8], image_z[8];
        integer many = m - begin < LANES ? m - begin : LANES;
        for (int i = 0; i < 6; i++)
            for (int j = 0; j < 6; j++)
                FOR_LANES scaled[i][j][lane] = moments[(6 * i + j) * m + begin + (lane < many ? lane : 0)];
        lanes total;
        FOR_LANES total[lane] = at_least(scaled[5][5][lane], 1e-9);
        for (int i = 0; i < 6; i++)
            for (int j = 0; j < 6; j++) FOR_LANES scaled[i][j][lane] /= total[lane];
        for (int i = 0; i < 6; i++) {
            FOR_LANES noise_a[i][lane] = variance_b * scaled[i][5][lane];
            FOR_LANES noise_b[i][lane] = variance_a * scaled[5][i][lane];
        }
        /* Entry (p, q) of the moment matrix, the constant term eliminated. */
        for (int p = 0; p < 8; p++) {
            double *edge = scaled[monomial[p / 3][2]][monomial[p % 3][2]];
            for (int q = 0; q <= p; q++) {
                double *other = scaled[monomial[q / 3][2]][monomial[q % 3][2]];
                double *whole = scaled[monomial[p / 3][q / 3]][monomial[p % 3][q % 3]];
                FOR_LANES work[p][q][lane] = whole[lane] - other[lane] * (edge[lane] / scaled[5][5][lane]);
            }
        }
        lanes least;
        FOR_LANES least[lane] = 0.0;
        for (int p = 0; p < 8; p++) FOR_LANES least[lane] += work[p][p][lane];
        FOR_LANES least[lane] = 1e-13 * at_least(least[lane], 1e-300);
        for (int k = 0; k < 8; k++) {
            lanes column[8];
            FOR_LANES work[k][k][lane] = at_least(work[k][k][lane], least[lane]);
            for (int i = k + 1; i < 8; i++) {
                FOR_LANES column[i][lane] = work[i][k][lane];
                FOR_LANES work[i][k][lane] /= work[k][k][lane];
            }
            for (int i = k + 1; i < 8; i++)
                for (int j = k + 1; j <= i; j++) FOR_LANES work[i][j][lane] -= work[i][k][lane] * column[j][lane];
        }
        for (int p = 0; p < 8; p++) FOR_LANES y[p][lane] = first[p];
        normalise(noise_a, noise_b, y, image);
        for (integer step = 0; step < iterations; step++) {
            lanes length;
            memcpy(by_moment, image, sizeof image);
            ldl_solve(work, image, y);
            normalise(noise_a, noise_b, y, image);
            dot(y, image, length);
            FOR_LANES length[lane] = 1.0 / sqrt(at_least(length[lane], 1e-300));
            for (int p = 0; p < 8; p++)
                FOR_LANES {
                    y[p][lane] *= length[lane];
                    image[p][lane] *= length[lane];
                    by_moment[p][lane] *= length[lane];
                }
        }
        ldl_solve(work, image, z);
        normalise(noise_a, noise_b, z, image_z);
        /* Rayleigh-Ritz step over the span of the last two. */
        lanes moment_y, moment_z, norm_z, along;
        dot(y, by_moment, moment_y);
        dot(z, image, moment_z);
        dot(z, image_z, norm_z);
        dot(y, image_z, along);
        for (int lane = 0; lane < many; lane++) {
            double length = at_least(norm_z[lane], 1e-300);
            double value = moment_z[lane] / length, share = along[lane] / length;
            double rest = at_least(1.0 - along[lane] * share, 0.0);
            if (rest > min_orthogonal) {
                double gap = 1.0 - share * moment_z[lane], across = gap * gap / (length * rest);
                double other = (moment_y[lane] - 2.0 * share + share * share * moment_z[lane]) / rest;
                double half = 0.5 * (other - value);
                value -= across / at_least(half + sqrt(half * half + across), 1e-300);
            }
            out[begin + lane] = value > 0.0 || isnan(value) ? value : 0.0;
        }
    }
}

/* hub.trajectory.image_tracks._neighbour_score: points (n, 2); rows (kept,): the good ones; scores (n,). */
void neighbour_scores(integer n, const double *time, const double *points, integer kept, const integer *rows,
                      integer one_sided, double share_of_lines, double *out)
{
    enum { EACH = 4 };
    integer passed = 0; /* good rows before this one */
    for (integer i = 0; i < n; i++) {
        int good = passed < kept && rows[passed] == i, known = 0;
        integer place[2 * EACH];
        double lines[EACH * EACH + EACH * (EACH - 1)];
        for (int k = 0; k < EACH; k++) {
            place[k] = passed - 1 - k;
            place[EACH + k] = passed + good + k;
        }
        for (int low = 0; low < 2 * EACH; low++)
            for (int high = 0; high < 2 * EACH; high++) {
                int two_sided = low < EACH && high >= EACH;
                int same_side = one_sided && (low < EACH ? high < low : high > low);
                if ((!two_sided && !same_side) || place[low] < 0 || place[high] < 0) continue;
                if (place[low] >= kept || place[high] >= kept) continue;
                integer p = rows[place[low]], q = rows[place[high]];
                double share = (time[i] - time[p]) / (time[q] - time[p]);
                double across = points[2 * i] - points[2 * p] - share * (points[2 * q] - points[2 * p]);
                double down = points[2 * i + 1] - points[2 * p + 1] - share * (points[2 * q + 1] - points[2 * p + 1]);
                double distance = sqrt(across * across + down * down);
                if (isfinite(distance)) lines[known++] = distance;
            }
        int pick = (int)ceil(share_of_lines * known) - 1;
        /* The smallest few in order, by selection. */
        for (int k = 0; k <= pick && k < known; k++)
            for (int j = k + 1; j < known; j++)
                if (lines[j] < lines[k]) {
                    double other = lines[k];
                    lines[k] = lines[j];
                    lines[j] = other;
                }
        out[i] = known ? lines[pick > 0 ? pick : 0] : 0.0;
        passed += good;
    }
}

/* Median of values (n,), which are reordered. */
static double median(integer n, double *values)
{
    integer middle = n / 2, low = 0, high = n - 1;
    while (low < high) { /* quickselect */
        double pivot = values[(low + high) / 2];
        integer i = low, j = high;
        while (i <= j) {
            while (values[i] < pivot) i++;
            while (values[j] > pivot) j--;
            if (i <= j) {
                double other = values[i];
                values[i++] = values[j];
                values[j--] = other;
            }
        }
        if (middle <= j) high = j;
        else if (middle >= i) low = i;
        else break;
    }
    if (n % 2) return values[middle];
    double below = values[0];
    for (integer i = 1; i < middle; i++)
        if (values[i] > below) below = values[i];
    return 0.5 * (below + values[middle]);
}

/* The symmetric matrix (9, 9) to diagonal form by Jacobi's rotations, which are applied to the columns of basis too. */
static void diagonalise(double matrix[9][9], double basis[9][9])
{
    double total = 0.0;
    for (int p = 0; p < 9; p++) total += fabs(matrix[p][p]);
    for (int sweep = 0; sweep < 30; sweep++) {
        double off = 0.0;
        for (int p = 0; p < 9; p++)
            for (int q = p + 1; q < 9; q++) off += fabs(matrix[p][q]);
        if (off <= 1e-18 * total) return;
        for (int p = 0; p < 9; p++)
            for (int q = p + 1; q < 9; q++) {
                if (fabs(matrix[p][q]) <= 1e-20 * total) continue;
                double theta = 0.5 * (matrix[q][q] - matrix[p][p]) / matrix[p][q];
                double t = (theta < 0.0 ? -1.0 : 1.0) / (fabs(theta) + sqrt(theta * theta + 1.0));
                double c = 1.0 / sqrt(t * t + 1.0), s = t * c;
                for (int k = 0; k < 9; k++) {
                    double x = matrix[k][p], y = matrix[k][q];
                    matrix[k][p] = c * x - s * y;
                    matrix[k][q] = s * x + c * y;
                }
                for (int k = 0; k < 9; k++) {
                    double x = matrix[p][k], y = matrix[q][k], v = basis[k][p], w = basis[k][q];
                    matrix[p][k] = c * x - s * y;
                    matrix[q][k] = s * x + c * y;
                    basis[k][p] = c * v - s * w;
                    basis[k][q] = s * v + c * w;
                }
            }
    }
}

/* hub.two_view.relative_pose.hartley_normalisation of points (2, n) to out; returns the spread. */
static double hartley(integer n, const double *points, double *out)
{
    double x = 0.0, y = 0.0, spread = 0.0;
    for (integer i = 0; i < n; i++) {
        x += points[i];
        y += points[n + i];
    }
    x /= (double)n;
    y /= (double)n;
    for (integer i = 0; i < n; i++) {
        out[i] = points[i] - x;
        out[n + i] = points[n + i] - y;
        spread += out[i] * out[i] + out[n + i] * out[n + i];
    }
    spread = at_least(sqrt(spread / (2.0 * (double)n)), 1e-12);
    for (integer i = 0; i < 2 * n; i++) out[i] /= spread;
    return spread;
}

/* hub.two_view.relative_pose.homography_residual of points (2, n) of a and b, before the division by the median of a
   Rayleigh variable. scratch: (6 n,). */
WIDE double homography_residual(integer n, const double *points_a, const double *points_b, integer iterations,
                           double *scratch)
{
    static const int index[3][3] = {{0, 1, 2}, {1, 3, 4}, {2, 4, 5}};
    double *a = scratch, *b = scratch + 2 * n, *weight = scratch + 4 * n, *distance = scratch + 5 * n;
    double basis[9][9] = {{0.0}}, h[9] = {0.0}, spread_a = hartley(n, points_a, a), spread_b = hartley(n, points_b, b);
    double scale = spread_b / spread_a; /* of units of b over units of a */
    for (int p = 0; p < 9; p++) basis[p][p] = 1.0;
    for (integer i = 0; i < n; i++) weight[i] = 1.0;
    for (integer step = 0; step < iterations; step++) {
        double sums[4][6] = {{0.0}}, normal[9][9] = {{0.0}}, turned[9][9], work[9][9];
        for (integer i = 0; i < n; i++) {
            double px = a[i], py = a[n + i], x = b[i], y = b[n + i], w = weight[i] * weight[i];
            double outer[6] = {px * px, px * py, px, py * py, py, 1.0}, of_b[4] = {w, -x * w, -y * w, (x * x + y * y) * w};
            for (int k = 0; k < 4; k++)
                for (int j = 0; j < 6; j++) sums[k][j] += of_b[k] * outer[j];
        }
        for (int p = 0; p < 3; p++)
            for (int q = 0; q < 3; q++) {
                int j = index[p][q];
                normal[p][q] = normal[3 + p][3 + q] = sums[0][j];
                normal[p][6 + q] = normal[6 + q][p] = sums[1][j];
                normal[3 + p][6 + q] = normal[6 + q][3 + p] = sums[2][j];
                normal[6 + p][6 + q] = sums[3][j];
            }
        /* From the eigenvectors of the step before few rotations are left. */
        for (int p = 0; p < 9; p++)
            for (int q = 0; q < 9; q++) {
                turned[p][q] = 0.0;
                for (int k = 0; k < 9; k++) turned[p][q] += normal[p][k] * basis[k][q];
            }
        for (int p = 0; p < 9; p++)
            for (int q = 0; q < 9; q++) {
                work[p][q] = 0.0;
                for (int k = 0; k < 9; k++) work[p][q] += basis[k][p] * turned[k][q];
            }
        diagonalise(work, basis);
        int least = 0;
        for (int p = 1; p < 9; p++)
            if (work[p][p] < work[least][least]) least = p;
        for (int p = 0; p < 9; p++) h[p] = basis[p][least];
        for (integer i = 0; i < n; i++) {
            double depth = h[6] * a[i] + h[7] * a[n + i] + h[8];
            depth = fabs(depth) > 1e-12 ? depth : 1e-12;
            double u = (h[0] * a[i] + h[1] * a[n + i] + h[2]) / depth, v = (h[3] * a[i] + h[4] * a[n + i] + h[5]) / depth;
            weight[i] = sqrt((u - b[i]) * (u - b[i]) + (v - b[n + i]) * (v - b[n + i]));
        }
        memcpy(distance, weight, sizeof(double) * (size_t)n);
        double width = at_least(3.0 * median(n, distance), 1e-12), largest = 0.0;
        for (integer i = 0; i < n; i++) {
            double depth = h[6] * a[i] + h[7] * a[n + i] + h[8], ratio = weight[i] / width;
            depth = fabs(depth) > 1e-12 ? depth : 1e-12;
            weight[i] = 1.0 / fabs(depth) / (1.0 + ratio * ratio);
            largest = at_least(weight[i], largest);
        }
        for (integer i = 0; i < n; i++) weight[i] /= largest;
    }
    for (integer i = 0; i < n; i++) {
        double depth = h[6] * a[i] + h[7] * a[n + i] + h[8];
        depth = fabs(depth) > 1e-12 ? depth : 1e-12;
        double u = (h[0] * a[i] + h[1] * a[n + i] + h[2]) / depth, v = (h[3] * a[i] + h[4] * a[n + i] + h[5]) / depth;
        double over = scale / depth, ex = u - b[i], ey = v - b[n + i];
        double s00 = (h[0] - u * h[6]) * over, s01 = (h[1] - u * h[7]) * over;
        double s10 = (h[3] - v * h[6]) * over, s11 = (h[4] - v * h[7]) * over, area = s00 * s11 - s01 * s10;
        double along0 = s00 * ey - s10 * ex, along1 = s01 * ey - s11 * ex;
        double determinant = 1.0 + s00 * s00 + s01 * s01 + s10 * s10 + s11 * s11 + area * area;
        distance[i] = sqrt(2.0 * (ex * ex + ey * ey + along0 * along0 + along1 * along1) / determinant);
    }
    return median(n, distance) * spread_b;
}

/* protocols.validation.layouts.Layouts.match of one message. layout: words of a message, number of covariances, six
   masks of each word, places of the covariances. */
static int matches(const unsigned char *payload, integer size, const uint64_t *layout)
{
    const uint64_t *mask = layout + 2, words = layout[0];
    uint64_t carry = 0, wrong = 0;
    for (uint64_t k = 0; k < words; k++, mask += 6) {
        uint64_t one = 0, left = (uint64_t)size - 8 * k;
        memcpy(&one, payload + 8 * k, left < 8 ? left : 8);
        uint64_t value = one & mask[2], sum = value + mask[3], total = sum + carry, unit = mask[5] >> 7;
        carry = (sum < value) | (total < sum);
        wrong |= ((one & mask[0]) ^ mask[1]) | ((total & mask[4]) ^ mask[5]);
        wrong |= ((one & (mask[5] - unit)) + unit) & mask[5];
    }
    if (wrong) return 0;
    for (uint64_t k = 0; k < layout[1]; k++) {
        double one[3];
        memcpy(one, payload + mask[k], sizeof one);
        if (!(one[1] * one[1] <= one[0] * one[2])) return 0;
    }
    return 1;
}

/* Whether each of n messages, which follow each other, matches a layout. tables: of each size up to most, 0 or the
   addresses of its layouts, and 0 at their end. */
void match_layouts(integer n, const integer *sizes, const unsigned char *payload, integer most,
                   const uint64_t *const *const *tables, unsigned char *found)
{
    for (integer i = 0; i < n; payload += sizes[i++]) {
        const uint64_t *const *table = sizes[i] <= most ? tables[sizes[i]] : 0;
        found[i] = 0;
        for (; table && *table && !found[i]; table++) found[i] = (unsigned char)matches(payload, sizes[i], *table);
    }
}

enum { ORIENTATIONS = 9 };

/* edge.uav.correlation.features: mean magnitude of each orientation (9, h / cell, w / cell) over square cells, each pixel
   (h, w) shared by the two orientations beside its angle [rad]. Sums in OpenCV's order: the same bits as cv2.resize. */
void orientation_cells(integer height, integer width, integer cell, const float *magnitude, const float *angle,
                       float *out)
{
    const integer rows = height / cell, columns = width / cell, area = cell * cell;
    const float per_radian = (float)(ORIENTATIONS / 3.14159265358979323846), share = 1.0f / (float)area;
    for (integer row = 0; row < rows; row++)
        for (integer column = 0; column < columns; column++) {
            float sums[ORIENTATIONS] = {0.0f}, four[ORIENTATIONS] = {0.0f};
            for (integer k = 0; k < area; k++) {
                const integer at = (row * cell + k / cell) * width + column * cell + k % cell;
                float place = angle[at] * per_radian;
                if (place >= ORIENTATIONS) place -= ORIENTATIONS;
                const integer low = (integer)place, next = low + 1 < ORIENTATIONS ? low + 1 : 0;
                if (low < ORIENTATIONS) {
                    four[low] += magnitude[at] * (1.0f - (place - (float)low));
                    four[next] += magnitude[at] * (1.0f - ((float)(low + 1) - place));
                } else
                    four[0] += magnitude[at];
                if (k % 4 == 3 || area - k <= area % 4)
                    for (integer o = 0; o < ORIENTATIONS; o++) {
                        sums[o] += four[o];
                        four[o] = 0.0f;
                    }
            }
            for (integer o = 0; o < ORIENTATIONS; o++) out[(o * rows + row) * columns + column] = sums[o] * share;
        }
}

/* edge.uav.ground.ego_motion._solve_pose: Geman-McClure Gauss-Newton of a camera over the plane, from ground points and
   their normalised coordinates (n, 2). state: rotation (3, 3) and centre (3,) with k = 6, homography (3, 3) with k = 8;
   in place. information, prior: (k,). unit: a pixel in normalised coordinates. scratch: (2 n,). */
void fit_plane_camera(integer n, const double *ground, const double *normalised, integer k, double *state,
                      const double *information, const double *prior, double unit, double noise, integer iterations,
                      double *scratch)
{
    enum { MOST = 8 };
    double total[MOST] = {0.0}, width = 0.0, *squared = scratch, *distance = scratch + n;
    for (integer step = 0; step < iterations; step++) {
        double h[9], m[MOST * MOST] = {0.0}, delta[MOST] = {0.0}, grown[9], next[9];
        memcpy(h, state, sizeof h);
        if (k == 6)
            for (int r = 0; r < 3; r++)
                h[3 * r + 2] = -(state[3 * r] * state[9] + state[3 * r + 1] * state[10] + state[3 * r + 2] * state[11]);
        for (integer i = 0; i < n; i++) {
            double gx = ground[2 * i], gy = ground[2 * i + 1], z = h[6] * gx + h[7] * gy + h[8];
            double depth = z > 1e-9 ? z : 1.0, u = normalised[2 * i] - (h[0] * gx + h[1] * gy + h[2]) / depth;
            double v = normalised[2 * i + 1] - (h[3] * gx + h[4] * gy + h[5]) / depth;
            squared[i] = u * u + v * v;
            distance[i] = sqrt(squared[i]);
        }
        double middle = median(n, distance);
        width = step ? at_least(at_least(width * 0.4, 2.5 * middle), 0.3 * unit) : at_least(middle * 1.5, 2.0 * unit);
        for (integer i = 0; i < n; i++) {
            double gx = ground[2 * i], gy = ground[2 * i + 1], z = h[6] * gx + h[7] * gy + h[8];
            if (!(z > 1e-9)) continue;
            double x = (h[0] * gx + h[1] * gy + h[2]) / z, y = (h[3] * gx + h[4] * gy + h[5]) / z;
            double u = normalised[2 * i] - x, v = normalised[2 * i + 1] - y, narrow = 1.0 + squared[i] / (width * width);
            double weight = 1.0 / (narrow * narrow) / (noise * noise);
            double across[MOST] = {-x * y, 1.0 + x * x, -y}, down[MOST] = {-1.0 - y * y, x * y, x};
            if (k == 6)
                for (int c = 0; c < 3; c++) {
                    across[3 + c] = (x * state[6 + c] - state[c]) / z;
                    down[3 + c] = (y * state[6 + c] - state[3 + c]) / z;
                }
            else {
                const double of_x[MOST] = {1.0, 0.0, -y, x, x, y, -x * x, -x * y};
                const double of_y[MOST] = {0.0, 1.0, x, y, -y, x, -x * y, -y * y};
                memcpy(across, of_x, sizeof across);
                memcpy(down, of_y, sizeof down);
            }
            for (integer a = 0; a < k; a++) {
                double wx = weight * across[a], wy = weight * down[a];
                for (integer b = a; b < k; b++) m[a * k + b] += wx * across[b] + wy * down[b];
                delta[a] += wx * u + wy * v;
            }
        }
        for (integer a = 0; a < k; a++) {
            for (integer b = 0; b < a; b++) m[a * k + b] = m[b * k + a];
            m[a * k + a] += information[a];
            delta[a] += information[a] * (prior[a] - total[a]);
        }
        solve(k, m, delta); /* definite: the prior alone is */
        for (integer a = 0; a < k; a++) total[a] += delta[a];
        if (k == 6) {
            rotation_of(delta, grown);
            for (int c = 0; c < 3; c++) state[9 + c] += delta[3 + c];
        } else {
            const double of[9] = {1.0 + delta[3] + delta[4], delta[5] - delta[2], delta[0],
                                  delta[2] + delta[5], 1.0 + delta[3] - delta[4], delta[1], delta[6], delta[7], 1.0};
            memcpy(grown, of, sizeof grown);
        }
        for (int r = 0; r < 3; r++)
            for (int c = 0; c < 3; c++)
                next[3 * r + c] = grown[3 * r] * state[c] + grown[3 * r + 1] * state[3 + c] + grown[3 * r + 2] * state[6 + c];
        double root = k == 6 ? 1.0
                             : cbrt(next[0] * (next[4] * next[8] - next[5] * next[7])
                                    - next[1] * (next[3] * next[8] - next[5] * next[6])
                                    + next[2] * (next[3] * next[7] - next[4] * next[6]));
        for (int c = 0; c < 9; c++) state[c] = next[c] / root;
        if (step >= 2 && at_least(fabs(delta[0]), fabs(delta[1])) < 0.01 * unit) break;
    }
}

/* A pinhole with Brown's distortion over a plane. homography: (3, 3), normalised from ground. */
typedef struct {
    const double *homography, *matrix, *coefficients;
    double fold, radius;
} plane_camera_t;

/* The pixel (2,) of a ground point; beyond ``radius`` the distortion stays what it is there; NaN behind. */
static INLINE void ground_pixel(const plane_camera_t *camera, double gx, double gy, double *pixel)
{
    const double *h = camera->homography, *m = camera->matrix;
    double z = h[6] * gx + h[7] * gy + h[8];
    if (!(z > 1e-9)) z = NAN;
    double x = (h[0] * gx + h[1] * gy + h[2]) / z, y = (h[3] * gx + h[4] * gy + h[5]) / z;
    pixel[0] = m[0] * x + m[1] * y + m[2];
    pixel[1] = m[3] * x + m[4] * y + m[5];
    if (!camera->coefficients) return;
    double from = sqrt(x * x + y * y), share = from > camera->radius ? camera->radius / from : 1.0;
    double flat[2] = {share * x, share * y}, bent[2], unused[4];
    if (!(flat[0] * flat[0] + flat[1] * flat[1] < camera->fold * camera->fold)) return; /* nothing to continue */
    brown_distortion(1, flat, camera->coefficients, bent, unused);
    pixel[0] += m[0] * (bent[0] - flat[0]) + m[1] * (bent[1] - flat[1]);
    pixel[1] += m[3] * (bent[0] - flat[0]) + m[4] * (bent[1] - flat[1]);
}

/* edge.uav.ground.image_plane.ImagePlane.project: pixels (n, 2) of ground points (n, 2). */
void ground_pixels(const double *homography, const double *matrix, const double *coefficients, double fold,
                   double radius, integer n, const double *points, double *pixels)
{
    const plane_camera_t camera = {homography, matrix, coefficients, fold, radius};
    for (integer i = 0; i < n; i++) ground_pixel(&camera, points[2 * i], points[2 * i + 1], pixels + 2 * i);
}

/* Bin of a colour of three bytes, with ``bits`` of each. */
static INLINE integer colour_bin(const uint8_t *colour, integer bits)
{
    const integer shift = 8 - bits;
    return ((integer)(colour[0] >> shift) << (2 * bits)) + ((integer)(colour[1] >> shift) << bits) + (colour[2] >> shift);
}

/* edge.uav.ground.colour_table.values: table (bins^3,) at colours (n, 3). */
void colour_values(integer n, const uint8_t *colours, integer bits, const float *table, float *out)
{
    for (integer i = 0; i < n; i++) out[i] = table[colour_bin(colours + 3 * i, bits)];
}

/* edge.uav.ground.colour_table.histogram (bins^3,) of colours (n, 3) with weights (n,), unless null; smoothed along each
   axis: ``centre`` of itself and ``side`` of either neighbour. */
void colour_histogram(integer n, const uint8_t *colours, const double *weights, integer bits, double centre,
                      double side, double *out)
{
    const integer bins = (integer)1 << bits, size = bins * bins * bins;
    memset(out, 0, sizeof(double) * (size_t)size);
    for (integer i = 0; i < n; i++) out[colour_bin(colours + 3 * i, bits)] += weights ? weights[i] : 1.0;
    for (integer step = bins * bins; step; step /= bins) /* planes, then rows, then single values */
        for (integer base = 0; base < size; base += bins * step) {
            double before[1024], *at = out + base;
            for (integer c = 0; c < step; c++) before[c] = 0.0;
            for (integer k = 0; k < bins; k++, at += step)
                for (integer c = 0; c < step; c++) {
                    double value = at[c], after = k + 1 < bins ? at[step + c] : 0.0;
                    at[c] = centre * value + side * (before[c] + after);
                    before[c] = value;
                }
        }
}

/* Means (h / factor, w / factor, 3) of an image (h, w, 3), rounded as cv2.resize with INTER_AREA does. sums: (3 w,). */
WIDE void reduce_image(integer height, integer width, integer factor, const uint8_t *image, uint16_t *sums,
                       uint8_t *out)
{
    const integer rows = height / factor, columns = width / factor, line = 3 * width;
    const float share = 1.0f / (float)(factor * factor), round_even = 12582912.0f; /* leaves no bits for a fraction */
    for (integer row = 0; row < rows; row++) {
        const uint8_t *from = image + row * factor * line;
        for (integer c = 0; c < line; c++) sums[c] = from[c];
        for (integer k = 1; k < factor; k++)
            for (integer c = 0; c < line; c++) sums[c] = (uint16_t)(sums[c] + from[k * line + c]);
        for (integer column = 0; column < columns; column++)
            for (integer c = 0; c < 3; c++) {
                const uint16_t *at = sums + 3 * factor * column + c;
                integer total = 0;
                for (integer k = 0; k < factor; k++) total += at[3 * k];
                float rounded = (float)total * share + round_even;
                *out++ = (uint8_t)(rounded - round_even);
            }
    }
}

/* Index of n in an image that is continued by its border value, and by its mirror image (OpenCV's default). */
static INLINE integer clamped(integer k, integer n) { return k < 0 ? 0 : k < n ? k : n - 1; }
static INLINE integer mirrored(integer k, integer n) { return clamped(k < 0 ? -k : k < n ? k : 2 * n - 2 - k, n); }

/* edge.uav.ground.photometric: colours (n, c) at points (n, 2) of an image (h, w, c) blurred over 5 x 5 px, as cv2.blur
   and cv2.remap give them. */
void blurred_colours(integer n, const float *points, integer height, integer width, integer channels,
                     const uint8_t *image, double *out)
{
    for (integer i = 0; i < n; i++) {
        const float left = floorf(points[2 * i]), top = floorf(points[2 * i + 1]);
        const float fx = points[2 * i] - left, fy = points[2 * i + 1] - top;
        const integer x = (integer)left, y = (integer)top;
        integer rows[2][5], columns[2][5];
        for (integer u = 0; u < 2; u++)
            for (integer k = 0; k < 5; k++) {
                rows[u][k] = mirrored(clamped(y + u, height) + k - 2, height) * width * channels;
                columns[u][k] = mirrored(clamped(x + u, width) + k - 2, width) * channels;
            }
        for (integer c = 0; c < channels; c++) {
            float blurred[2][2];
            for (integer v = 0; v < 2; v++)
                for (integer u = 0; u < 2; u++) {
                    int total = 0;
                    for (integer k = 0; k < 5; k++)
                        for (integer j = 0; j < 5; j++) total += image[rows[v][k] + columns[u][j] + c];
                    blurred[v][u] = (float)((2 * total + 25) / 50);
                }
            out[i * channels + c] = blurred[0][0] * ((1.0f - fy) * (1.0f - fx)) + blurred[0][1] * ((1.0f - fy) * fx)
                                    + blurred[1][0] * (fy * (1.0f - fx)) + blurred[1][1] * (fy * fx);
        }
    }
}

/* edge.uav.target.motion_history.MotionHistory.fit: position, velocity and acceleration (3, 2) of positions (n, 2) at
   times (n,) before now, in three steps with Cauchy weights. information: (3,), right: (3, 2) of the prior. Left are the
   last normal matrix (3, 3), errors (n,) and weights (n,). */
void fit_motion(integer n, const double *time, const double *positions, const double *stds, const double *information,
                const double *right, double *weight, double *solution, double *normal, double *error)
{
    for (int step = 0; step < 3; step++) {
        double m[9], values[2][3];
        for (int a = 0; a < 3; a++)
            for (int c = 0; c < 2; c++) values[c][a] = right[2 * a + c];
        memset(normal, 0, sizeof m);
        for (int a = 0; a < 3; a++) normal[4 * a] = information[a];
        for (integer i = 0; i < n; i++) {
            const double row[3] = {1.0, time[i], 0.5 * time[i] * time[i]};
            for (int a = 0; a < 3; a++) {
                for (int b = 0; b < 3; b++) normal[3 * a + b] += row[a] * weight[i] * row[b];
                for (int c = 0; c < 2; c++) values[c][a] += row[a] * weight[i] * positions[2 * i + c];
            }
        }
        for (int c = 0; c < 2; c++) {
            memcpy(m, normal, sizeof m);
            solve(3, m, values[c]); /* definite: the prior alone is */
            for (int a = 0; a < 3; a++) solution[2 * a + c] = values[c][a];
        }
        for (integer i = 0; i < n; i++) {
            double half = 0.5 * time[i] * time[i], dx = solution[0] + time[i] * solution[2] + half * solution[4];
            double dy = solution[1] + time[i] * solution[3] + half * solution[5];
            dx -= positions[2 * i];
            dy -= positions[2 * i + 1];
            error[i] = sqrt(dx * dx + dy * dy);
            double ratio = error[i] / (3.0 * stds[i]);
            weight[i] = 1.0 / (stds[i] * stds[i]) / (1.0 + ratio * ratio);
        }
    }
}

/* Position, velocity and acceleration in three coordinates, and their covariance. */
enum { STATE = 9, SQUARE = 81, BANK = 3 };

/* hub.tracking.filter.jerk_model.jerk_model applied to mean (9,) and covariance (9, 9). left: (9, 9) transition times
   covariance, or null. */
static void predict_jerk(double dt, double psd, const double *mean, const double *covariance, double *to,
                         double *spread, double *left)
{
    const double half = 0.5 * dt * dt, square = dt * dt, cube = square * dt;
    const double noise[3][3] = {{square * cube / 20.0, square * square / 8.0, cube / 6.0},
                                {square * square / 8.0, cube / 3.0, square / 2.0},
                                {cube / 6.0, square / 2.0, dt}};
    double rows[SQUARE];
    for (int i = 0; i < 3; i++) {
        to[i] = mean[i] + dt * mean[3 + i] + half * mean[6 + i];
        to[3 + i] = mean[3 + i] + dt * mean[6 + i];
        to[6 + i] = mean[6 + i];
    }
    for (int i = 0; i < 27; i++) {
        rows[i] = covariance[i] + dt * covariance[27 + i] + half * covariance[54 + i];
        rows[27 + i] = covariance[27 + i] + dt * covariance[54 + i];
        rows[54 + i] = covariance[54 + i];
    }
    if (left) memcpy(left, rows, sizeof rows);
    for (int r = 0; r < STATE; r++) {
        const double *from = rows + STATE * r;
        double *row = spread + STATE * r;
        for (int i = 0; i < 3; i++) {
            row[i] = from[i] + dt * from[3 + i] + half * from[6 + i];
            row[3 + i] = from[3 + i] + dt * from[6 + i];
            row[6 + i] = from[6 + i];
        }
        for (int block = 0; block < 3; block++) row[3 * block + r % 3] += psd * noise[r / 3][block];
    }
}

/* hub.tracking.marker_filter._with_scale_at for one filter. 0 if its covariance is singular. */
static int keep_scale(const double *centre, const double *before, const double *after, double *covariance)
{
    double old[STATE], new[STATE], solved[STATE], matrix[SQUARE], information = 0.0;
    for (int i = 0; i < STATE; i++) {
        old[i] = solved[i] = before[i] - (i < 3 ? centre[i] : 0.0);
        new[i] = after[i] - (i < 3 ? centre[i] : 0.0);
    }
    memcpy(matrix, covariance, sizeof matrix);
    if (!solve(STATE, matrix, solved)) return 0;
    for (int i = 0; i < STATE; i++) information += old[i] * solved[i];
    for (int i = 0; i < STATE; i++)
        for (int j = 0; j < STATE; j++)
            covariance[STATE * i + j] += (new[i] * new[j] - old[i] * old[j]) / information;
    return 1;
}

/* hub.tracking.marker_filter._filtered: three filters, mean (3, 9) and covariance (3, 9, 9), by one row. camera: its
   rotation (3, 3) and centre. row: point, noise xx, xy, yy. out: fits and excesses (3,) of both. 0 where the row is
   outside the gate. */
double filter_row(double dt, const double *psd, const double *mean, const double *covariance, integer likeliest,
                  const double *camera, double time_std, const double *row, double factor, integer linearisations,
                  double linear, double gate, double *to, double *spread, double *out)
{
    const double *rotation = camera, *centre = camera + 9;
    double moved[BANK][3], prior[BANK][3], at[BANK][3], cross[BANK][2 * STATE], inverse[BANK][3], step[BANK][STATE];
    double distance = 0.0;
    for (int k = 0; k < BANK; k++) {
        double *position = to + STATE * k;
        predict_jerk(dt, psd[k], mean + STATE * k, covariance + SQUARE * k, position, spread + SQUARE * k, 0);
        for (int i = 0; i < 3; i++) {
            prior[k][i] = moved[k][i] = 0.0;
            for (int j = 0; j < 3; j++) {
                prior[k][i] += rotation[3 * i + j] * (position[j] - centre[j]);
                moved[k][i] += rotation[3 * i + j] * time_std * position[3 + j];
            }
        }
    }
    if (!(prior[likeliest][2] > 0.0)) return 0.0;
    for (int k = 0; k < BANK; k++)
        if (!(prior[k][2] > 0.0)) { /* its depth is lost: it begins again from the likeliest one */
            memcpy(to + STATE * k, to + STATE * likeliest, STATE * sizeof *to);
            memcpy(spread + SQUARE * k, spread + SQUARE * likeliest, SQUARE * sizeof *to);
            memcpy(prior[k], prior[likeliest], sizeof *prior);
        }
    memcpy(at, prior, sizeof at);
    for (integer pass = 0; pass < linearisations; pass++) {
        double far = 0.0, nearest = INFINITY;
        for (int k = 0; k < BANK; k++) {
            const double x = at[k][0], y = at[k][1], z = at[k][2], *p = spread + SQUARE * k;
            const double a = 1.0 / z, b = -x / (z * z), d = -y / (z * z);
            double jacobian[2][3], su[2][2];
            for (int j = 0; j < 3; j++) {
                jacobian[0][j] = a * rotation[j] + b * rotation[6 + j];
                jacobian[1][j] = a * rotation[3 + j] + d * rotation[6 + j];
            }
            for (int i = 0; i < STATE; i++)
                for (int e = 0; e < 2; e++) {
                    double sum = 0.0;
                    for (int j = 0; j < 3; j++) sum += p[STATE * i + j] * jacobian[e][j];
                    cross[k][2 * i + e] = sum;
                }
            for (int e = 0; e < 2; e++)
                for (int f = 0; f < 2; f++) {
                    su[e][f] = 0.0;
                    for (int j = 0; j < 3; j++) su[e][f] += jacobian[e][j] * cross[k][2 * j + f];
                }
            double u = row[0] - x / z - a * (prior[k][0] - x) - b * (prior[k][2] - z);
            double v = row[1] - y / z - a * (prior[k][1] - y) - d * (prior[k][2] - z);
            double mu = a * moved[k][0] + b * moved[k][2], mv = a * moved[k][1] + d * moved[k][2];
            double nuu = factor * row[2] + mu * mu, nuv = factor * row[3] + mu * mv, nvv = factor * row[4] + mv * mv;
            double suu = su[0][0] + nuu, suv = su[0][1] + nuv, svv = su[1][1] + nvv;
            double determinant = suu * svv - suv * suv;
            if (!(determinant > 0.0)) return 0.0;
            double iuu = svv / determinant, iuv = -suv / determinant, ivv = suu / determinant;
            double ru = iuu * u + iuv * v, rv = iuv * u + ivv * v;
            distance = u * ru + v * rv;
            inverse[k][0] = iuu;
            inverse[k][1] = iuv;
            inverse[k][2] = ivv;
            out[k] = -0.5 * (distance + log(determinant));
            out[BANK + k] = 0.5 * (nuu * ru * ru + 2.0 * nuv * ru * rv + nvv * rv * rv - nuu * iuu -
                                   2.0 * nuv * iuv - nvv * ivv);
            for (int i = 0; i < STATE; i++) step[k][i] = cross[k][2 * i] * ru + cross[k][2 * i + 1] * rv;
            double next[3];
            for (int i = 0; i < 3; i++) {
                next[i] = 0.0;
                for (int j = 0; j < 3; j++)
                    next[i] += rotation[3 * i + j] * (to[STATE * k + j] + step[k][j] - centre[j]);
                far = fmax(far, fabs(next[i] - at[k][i]) / z);
            }
            memcpy(at[k], next, sizeof next);
            nearest = fmin(nearest, next[2]);
        }
        if (far < linear || !(nearest > 0.0)) break;
    }
    if (!(distance < gate)) return 0.0;
    for (int k = 0; k < BANK; k++) {
        double *p = spread + SQUARE * k, before[STATE];
        memcpy(before, to + STATE * k, sizeof before);
        for (int i = 0; i < STATE; i++) to[STATE * k + i] += step[k][i];
        if (linearisations == 1 && !keep_scale(centre, before, to + STATE * k, p)) return 0.0;
        for (int i = 0; i < STATE; i++) {
            const double *ci = cross[k] + 2 * i;
            double gu = ci[0] * inverse[k][0] + ci[1] * inverse[k][1];
            double gv = ci[0] * inverse[k][1] + ci[1] * inverse[k][2];
            for (int j = 0; j < STATE; j++) p[STATE * i + j] -= gu * cross[k][2 * j] + gv * cross[k][2 * j + 1];
        }
        for (int i = 0; i < STATE; i++)
            for (int j = 0; j < i; j++)
                p[STATE * i + j] = p[STATE * j + i] = 0.5 * (p[STATE * i + j] + p[STATE * j + i]);
    }
    return 1.0;
}

/* a (9, 9) times b (9, columns). */
static void times(int columns, const double *a, const double *b, double *out)
{
    for (int i = 0; i < STATE; i++) {
        double *row = out + columns * i;
        for (int j = 0; j < columns; j++) row[j] = 0.0;
        for (int k = 0; k < STATE; k++)
            for (int j = 0; j < columns; j++) row[j] += a[STATE * i + k] * b[columns * k + j];
    }
}

/* hub.tracking.filter.jerk_model.rts_smooth of states (n, 9), (n, 9, 9) at times (n,): the first ``wanted``. 0 if a
   covariance is singular. */
double smooth_jerk(integer n, integer wanted, const double *time, const double *psd, const double *mean,
                   const double *covariance, double *smoothed, double *spreads)
{
    double next[STATE], spread[SQUARE];
    memcpy(next, mean + STATE * (n - 1), sizeof next);
    memcpy(spread, covariance + SQUARE * (n - 1), sizeof spread);
    for (integer s = n - 1;; s--) {
        if (s < wanted) {
            memcpy(smoothed + STATE * s, next, sizeof next);
            memcpy(spreads + SQUARE * s, spread, sizeof spread);
        }
        if (s == 0) return 1.0;
        const double *m = mean + STATE * (s - 1), *p = covariance + SQUARE * (s - 1);
        double ahead[STATE], predicted[SQUARE], scaled[SQUARE], cross[SQUARE], gain[SQUARE], turned[SQUARE];
        double scale[STATE], off[STATE], other[SQUARE];
        predict_jerk(time[s] - time[s - 1], psd[s], m, p, ahead, predicted, cross);
        for (int i = 0; i < STATE; i++) scale[i] = 1.0 / sqrt(predicted[10 * i]);
        for (int i = 0; i < STATE; i++)
            for (int j = 0; j < STATE; j++) scaled[STATE * i + j] = predicted[STATE * i + j] * scale[i] * scale[j];
        /* Cholesky; the gain's rows solve for the columns of transition times covariance. */
        for (int j = 0; j < STATE; j++)
            for (int i = j; i < STATE; i++) {
                double sum = scaled[STATE * i + j];
                for (int k = 0; k < j; k++) sum -= scaled[STATE * i + k] * scaled[STATE * j + k];
                if (i == j && !(sum > 0.0)) return 0.0;
                scaled[STATE * i + j] = i == j ? sqrt(sum) : sum / scaled[STATE * j + j];
            }
        for (int i = 0; i < STATE; i++) {
            double *row = cross + STATE * i;
            for (int c = 0; c < STATE; c++) row[c] *= scale[i];
            for (int k = 0; k < i; k++)
                for (int c = 0; c < STATE; c++) row[c] -= scaled[STATE * i + k] * cross[STATE * k + c];
            for (int c = 0; c < STATE; c++) row[c] /= scaled[STATE * i + i];
        }
        for (int i = STATE - 1; i >= 0; i--) {
            double *row = cross + STATE * i;
            for (int k = i + 1; k < STATE; k++)
                for (int c = 0; c < STATE; c++) row[c] -= scaled[STATE * k + i] * cross[STATE * k + c];
            for (int c = 0; c < STATE; c++) row[c] /= scaled[STATE * i + i];
        }
        for (int i = 0; i < STATE; i++)
            for (int c = 0; c < STATE; c++) {
                gain[STATE * c + i] = cross[STATE * i + c] * scale[i];
                turned[STATE * i + c] = cross[STATE * i + c] * scale[i];
            }
        for (int i = 0; i < STATE; i++) off[i] = next[i] - ahead[i];
        times(1, gain, off, next);
        for (int i = 0; i < STATE; i++) next[i] += m[i];
        for (int i = 0; i < SQUARE; i++) spread[i] -= predicted[i];
        times(STATE, gain, spread, other);
        times(STATE, other, turned, spread);
        for (int i = 0; i < SQUARE; i++) spread[i] += p[i];
    }
}

/* A grid of values (rows, columns) whose first cell begins at (x, y). */
typedef struct {
    double x, y, cell;
    integer rows, columns;
    const float *values;
} grid_t;

/* Its value at a point; 0 outside. */
static INLINE double grid_value(const grid_t *grid, double px, double py)
{
    double column = floor((px - grid->x) / grid->cell), row = floor((py - grid->y) / grid->cell);
    if (!(column >= 0.0 && row >= 0.0 && column < (double)grid->columns && row < (double)grid->rows)) return 0.0;
    return grid->values[(integer)row * grid->columns + (integer)column];
}

/* edge.uav.ground.road_map.RoadMap: values (n,) at points (n, 2). */
void grid_values(double x, double y, double cell, integer rows, integer columns, const float *values, integer n,
                 const double *points, double *out)
{
    const grid_t grid = {x, y, cell, rows, columns, values};
    for (integer i = 0; i < n; i++) out[i] = grid_value(&grid, points[2 * i], points[2 * i + 1]);
}

/* edge.uav.prediction.paths.road_edges: distances (2, n), right and left, of ``count`` with ``step`` between them. */
void road_edges(double x, double y, double cell, integer rows, integer columns, const float *values, integer n,
                const double *points, const double *headings, integer count, double step, double off, double unknown,
                integer most_unknown, double *out)
{
    const grid_t grid = {x, y, cell, rows, columns, values};
    for (integer side = 0; side < 2; side++)
        for (integer i = 0; i < n; i++) {
            double across = sin(headings[i]), along = cos(headings[i]), *to = out + side * n + i;
            integer blank = 0;
            *to = NAN;
            for (integer k = 0; k < count; k++) {
                double reach = side ? -step * (double)k : step * (double)k;
                double odds = grid_value(&grid, points[2 * i] - reach * across, points[2 * i + 1] + reach * along);
                blank += fabs(odds) < unknown;
                if (!(odds < off)) continue;
                if (k && blank <= most_unknown) *to = fabs(reach);
                break;
            }
        }
}

/* edge.uav.prediction.paths._look_ahead: of points (arcs, steps, offsets) in the axes of a car at (px, py), mean weighted
   values (arcs,) within limits, shares that are known (arcs,), and whether any is in the first steps. */
void arc_values(double x, double y, double cell, integer rows, integer columns, const float *values, integer arcs,
                integer steps, integer offsets, const double *forward, const double *lateral, const double *weights,
                double px, double py, double heading, double known, const double *limits, integer first, double *out)
{
    const grid_t grid = {x, y, cell, rows, columns, values};
    const double c = cos(heading), s = sin(heading), many = (double)(steps * offsets);
    double *seen = out + arcs, *near = out + 2 * arcs;
    *near = 0.0;
    for (integer arc = 0; arc < arcs; arc++) {
        double total = 0.0, count = 0.0;
        for (integer step = 0; step < steps; step++)
            for (integer k = 0; k < offsets; k++) {
                double ahead = *forward++, aside = *lateral++;
                double odds = grid_value(&grid, px + c * ahead - s * aside, py + s * ahead + c * aside);
                int observed = fabs(odds) > known;
                if (observed && step < first) *near = 1.0;
                count += observed;
                total += weights[step] * (observed ? at_least(odds < limits[1] ? odds : limits[1], limits[0]) : limits[2]);
            }
        out[arc] = total / many;
        seen[arc] = count / many;
    }
}

/* edge.uav.prediction.particle_filter.densest_cluster of points (n, 2): members (n,), centre (2,) and weight in out.
   scratch: (2, n). */
WIDE void densest_cluster(integer n, const double *points, const double *weights, double radius, double *scratch,
                          uint8_t *members, double *out)
{
    double *column = scratch, *row = scratch + n, best = -1.0, x = 0.0, y = 0.0, total = 0.0;
    integer fullest = 0;
    for (integer i = 0; i < n; i++) {
        column[i] = floor(points[2 * i] / radius);
        row[i] = floor(points[2 * i + 1] / radius);
    }
    for (integer i = 0; i < n; i++) {
        double around = 0.0;
        for (integer j = 0; j < n; j++) {
            double dx = fabs(column[j] - column[i]), dy = fabs(row[j] - row[i]);
            around += (dx <= 1.0) & (dy <= 1.0) ? weights[j] * (dx + dy > 0.0 ? 1.0 : 1.0 + 1e-9) : 0.0;
        }
        if (around > best) best = around, fullest = i;
    }
    for (integer i = 0; i < n; i++) {
        members[i] = column[i] == column[fullest] && row[i] == row[fullest];
        if (!members[i]) continue;
        double weight = weights[i] + 1e-300;
        x += weight * points[2 * i];
        y += weight * points[2 * i + 1];
        total += weight;
    }
    x /= total;
    y /= total;
    for (int step = 0; step < 10; step++) {
        double sum = 0.0, sum_x = 0.0, sum_y = 0.0;
        integer changed = 0;
        for (integer i = 0; i < n; i++) {
            double dx = points[2 * i] - x, dy = points[2 * i + 1] - y;
            uint8_t within = dx * dx + dy * dy <= radius * radius;
            scratch[i] = within;
            changed += within != members[i];
            sum += within ? weights[i] : 0.0;
            sum_x += within ? weights[i] * points[2 * i] : 0.0;
            sum_y += within ? weights[i] * points[2 * i + 1] : 0.0;
        }
        if (!(sum > 0.0) || !changed) break;
        for (integer i = 0; i < n; i++) members[i] = scratch[i] != 0.0;
        x = sum_x / sum;
        y = sum_y / sum;
    }
    out[0] = x;
    out[1] = y;
    out[2] = 0.0;
    for (integer i = 0; i < n; i++) out[2] += members[i] ? weights[i] : 0.0;
}

/* edge.uav.ground_tracker.GroundTracker._open_road: of each car at positions (n, 2), how many of its middle and its ends,
   ``reach`` away along its heading, have a colour with a value above ``least`` in the reduced image (h, w, 3). levels:
   (256, 3) that take the place of the image's, or null. */
void open_road(const double *homography, const double *matrix, const double *coefficients, double fold, double radius,
               integer n, const double *positions, const double *headings, double reach, double factor, integer height,
               integer width, const uint8_t *image, const uint8_t *levels, integer bits, const float *table,
               double least, integer *counts)
{
    const plane_camera_t camera = {homography, matrix, coefficients, fold, radius};
    for (integer i = 0; i < n; i++) {
        double dx = reach * cos(headings[i]), dy = reach * sin(headings[i]), pixel[2];
        counts[i] = 0;
        for (int end = -1; end <= 1; end++) {
            ground_pixel(&camera, positions[2 * i] + end * dx, positions[2 * i + 1] + end * dy, pixel);
            double x = pixel[0] / factor, y = pixel[1] / factor;
            integer column = x > 0.0 ? (integer)(x < (double)width ? x : (double)(width - 1)) : 0;
            integer row = y > 0.0 ? (integer)(y < (double)height ? y : (double)(height - 1)) : 0;
            uint8_t colour[3];
            for (int c = 0; c < 3; c++) {
                colour[c] = image[3 * (row * width + column) + c];
                if (levels) colour[c] = levels[3 * colour[c] + c];
            }
            counts[i] += table[colour_bin(colour, bits)] > (float)least;
        }
    }
}

/* edge.uav.ground.road_map.RoadMap.update: of a map (rows, columns), values of the colours of its cells in an image
   (h, w, 3), by a table; 0 within two pixels of its border and beyond. pixels: (m, k, 2) of a mesh over the map, linear
   between its points. scratch: (2 k + columns,). */
void road_evidence(integer m, integer k, const double *pixels, integer rows, integer columns, integer height,
                   integer width, const uint8_t *image, integer bits, const float *table, double *scratch, float *out)
{
    double *line = scratch, *place = scratch + 2 * k;
    for (integer column = 0; column < columns; column++)
        place[column] = (double)column * (double)(k - 1) / (double)(columns - 1);
    for (integer row = 0; row < rows; row++) {
        double down = (double)row * (double)(m - 1) / (double)(rows - 1);
        integer low = clamped((integer)down, m - 1);
        const double *from = pixels + 2 * k * low, part = down - (double)low;
        for (integer c = 0; c < 2 * k; c++) line[c] = from[c] + part * (from[2 * k + c] - from[c]);
        for (integer column = 0; column < columns; column++) {
            integer left = clamped((integer)place[column], k - 1);
            const double *at = line + 2 * left, share = place[column] - (double)left;
            double x = at[0] + share * (at[2] - at[0]), y = at[1] + share * (at[3] - at[1]);
            int inside = (x > 1.0) & (y > 1.0) & (x < (double)(width - 2)) & (y < (double)(height - 2));
            *out++ = inside ? table[colour_bin(image + 3 * ((integer)(y + 0.5) * width + (integer)(x + 0.5)), bits)] : 0.0f;
        }
    }
}
