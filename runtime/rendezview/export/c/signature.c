/* Outline to signature: bearing and area, the outermost edge in each direction, integer readings.
 *
 * The operations and their order are those of rendezview's own runtime, so that the readings are
 * the same: keep them when the code is edited. */
#include <math.h>
#include <stddef.h>

#include "rendezview_flight.h"

#define PI 3.14159265358979323846
#define UNIT 1000.0          /* readings per square root of the area */
#define MOST_TANGENT 1.0e6   /* of a ray: no camera looks farther from its boresight */
#define LEAST_DEPTH 1.0e-9   /* more than a right angle from the centroid: no outline of a target */
#define LEAST_ACROSS 1.0e-300

static rdv_f64 larger(rdv_f64 a, rdv_f64 b)
{
    return (b > a) ? b : a;
}

static rdv_f64 smaller(rdv_f64 a, rdv_f64 b)
{
    return (b < a) ? b : a;
}

/* 1/2 of the closed integral of r x dr over unit rays: to the centroid, as long as the area. */
static void add_vector_area(const rdv_point *rays, uint32_t count, rdv_f64 total[3])
{
    rdv_f64 sum[3] = {0.0, 0.0, 0.0};

    if (count > 0u)
    {
        const rdv_point *const last = &rays[count - 1u];
        const rdv_f64 length = sqrt(((last->x * last->x) + (last->y * last->y)) + 1.0);
        rdv_f64 ax = last->x / length;
        rdv_f64 ay = last->y / length;
        rdv_f64 az = 1.0 / length;
        uint32_t i;

        for (i = 0u; i < count; i++)
        {
            const rdv_f64 x = rays[i].x;
            const rdv_f64 y = rays[i].y;
            const rdv_f64 bz = 1.0 / sqrt(((x * x) + (y * y)) + 1.0);
            const rdv_f64 bx = x * bz;
            const rdv_f64 by = y * bz;

            sum[0] -= 0.5 * ((ay * bz) - (az * by));
            sum[1] -= 0.5 * ((az * bx) - (ax * bz));
            sum[2] -= 0.5 * ((ax * by) - (ay * bx));
            ax = bx;
            ay = by;
            az = bz;
        }
    }
    total[0] += sum[0];
    total[1] += sum[1];
    total[2] += sum[2];
}

static void normalise(rdv_f64 v[3])
{
    const rdv_f64 length = sqrt(((v[0] * v[0]) + (v[1] * v[1])) + (v[2] * v[2]));

    v[0] /= length;
    v[1] /= length;
    v[2] /= length;
}

/* The rotation of least angle that turns a direction to the boresight (0, 0, 1). */
static void turn_to_boresight(const rdv_f64 direction[3], rdv_f64 rotation[9])
{
    rdv_f64 a[3] = {direction[0], direction[1], direction[2]};
    rdv_f64 axis[3];
    const rdv_f64 largest = larger(larger(fabs(a[0]), fabs(a[1])), fabs(a[2]));
    rdv_f64 sine;
    rdv_f64 cosine;
    rdv_f64 size;
    rdv_f64 rest;
    rdv_f64 along;
    uint32_t k;

    for (k = 0u; k < 3u; k++)
    {
        a[k] /= largest; /* no overflow or underflow in the norm */
    }
    normalise(a);
    axis[0] = a[1];
    axis[1] = -a[0];
    axis[2] = 0.0;
    cosine = a[2];
    sine = sqrt(((axis[0] * axis[0]) + (axis[1] * axis[1])) + (axis[2] * axis[2]));
    if ((sine < 1e-14) && (cosine > 0.0))
    {
        for (k = 0u; k < 9u; k++)
        {
            rotation[k] = ((k % 4u) == 0u) ? 1.0 : 0.0;
        }
    }
    else
    {
        if (sine < 1e-14)
        {
            /* backwards: any axis across, towards the least component */
            axis[0] = (fabs(a[0]) <= fabs(a[1])) ? 1.0 : 0.0;
            axis[1] = 1.0 - axis[0];
        }
        else
        {
            axis[0] /= sine;
            axis[1] /= sine;
            axis[2] /= sine;
        }
        along = ((axis[0] * a[0]) + (axis[1] * a[1])) + (axis[2] * a[2]);
        for (k = 0u; k < 3u; k++)
        {
            axis[k] -= a[k] * along;
        }
        normalise(axis);
        size = sqrt((sine * sine) + (cosine * cosine));
        sine /= size;
        cosine /= size;
        rest = (cosine > 0.0) ? ((sine * sine) / (1.0 + cosine)) : (1.0 - cosine);
        rotation[0] = 1.0 - (rest * ((axis[1] * axis[1]) + (axis[2] * axis[2])));
        rotation[4] = 1.0 - (rest * ((axis[0] * axis[0]) + (axis[2] * axis[2])));
        rotation[8] = 1.0 - (rest * ((axis[0] * axis[0]) + (axis[1] * axis[1])));
        rotation[1] = ((rest * axis[0]) * axis[1]) - (sine * axis[2]);
        rotation[3] = ((rest * axis[0]) * axis[1]) + (sine * axis[2]);
        rotation[2] = ((rest * axis[0]) * axis[2]) + (sine * axis[1]);
        rotation[6] = ((rest * axis[0]) * axis[2]) - (sine * axis[1]);
        rotation[5] = ((rest * axis[1]) * axis[2]) - (sine * axis[0]);
        rotation[7] = ((rest * axis[1]) * axis[2]) + (sine * axis[0]);
    }
}

/* atan2 to 1e-5 rad, which only decides the bins that a segment is tested for: Abramowitz and
 * Stegun 4.4.49. */
static rdv_f64 nearly_atan2(rdv_f64 y, rdv_f64 x)
{
    const rdv_f64 ax = fabs(x);
    const rdv_f64 ay = fabs(y);
    const rdv_f64 large = larger(ax, ay);
    rdv_f64 angle = 0.0;

    if (large > 0.0)
    {
        const rdv_f64 t = smaller(ax, ay) / large;
        const rdv_f64 s = t * t;

        angle =
            t *
            (0.9998660 +
             (s * (-0.3302995 + (s * (0.1801410 + (s * (-0.0851330 + (s * 0.0208351))))))));
        if (ay > ax)
        {
            angle = (0.5 * PI) - angle;
        }
        if (x < 0.0)
        {
            angle = PI - angle;
        }
        if (y < 0.0)
        {
            angle = -angle;
        }
    }
    return angle;
}

/* One segment of an outline: its crossings with the rays of the bins, if they lie farther out. */
static void reach_out(const rdv_f64 from[3], const rdv_f64 to[3], rdv_f64 maxima[RDV_BINS])
{
    const rdv_f64 half = 0.5 * (rdv_f64)RDV_BINS;
    rdv_f64 low = from[2];
    rdv_f64 high = to[2];
    int32_t first;
    int32_t last;

    if ((high - low) > half)
    {
        low += (rdv_f64)RDV_BINS;
    }
    else if ((low - high) > half)
    {
        high += (rdv_f64)RDV_BINS;
    }
    else
    {
        /* not across West */
    }
    first = (int32_t)ceil(smaller(low, high));
    last = (int32_t)floor(larger(low, high));
    if (first <= last)
    {
        const rdv_f64 dx = to[0] - from[0];
        const rdv_f64 dy = to[1] - from[1];
        const rdv_f64 cross = (from[0] * dy) - (from[1] * dx);
        const rdv_f64 farther = sqrt(larger((from[0] * from[0]) + (from[1] * from[1]),
                                            (to[0] * to[0]) + (to[1] * to[1])));
        int32_t b;

        for (b = first; b <= last; b++)
        {
            int32_t k = b;
            rdv_f64 distance = farther;
            rdv_f64 across;

            if (k < 0)
            {
                k += (int32_t)RDV_BINS;
            }
            if (k >= (int32_t)RDV_BINS)
            {
                k -= (int32_t)RDV_BINS;
            }
            across = (rdv_spokes[k][0] * dy) - (rdv_spokes[k][1] * dx);
            if (fabs(across) > LEAST_ACROSS) /* along the ray the quotient is rounding */
            {
                distance = smaller(farther, cross / across);
            }
            if (distance > maxima[k])
            {
                maxima[k] = distance;
            }
        }
    }
}

/* Distance to the outermost edge in each bin, across the boresight at unit distance. */
static void radial_maxima(const rdv_point *rays, uint32_t count, const rdv_f64 q[9],
                          rdv_f64 maxima[RDV_BINS])
{
    const rdv_f64 per_radian = (rdv_f64)RDV_BINS / (2.0 * PI);
    rdv_f64 from[3] = {0.0, 0.0, 0.0}; /* x, y up on the screen, angle in bins */
    rdv_f64 to[3];
    uint32_t step = 0u; /* the first step only finds the last point */
    int32_t before = 1; /* no ray is behind */

    while ((count > 0u) && (step <= count) && (before == 1))
    {
        const rdv_point *const ray = &rays[(step == 0u) ? (count - 1u) : (step - 1u)];
        const rdv_f64 z = ((q[6] * ray->x) + (q[7] * ray->y)) + q[8];

        if (z <= LEAST_DEPTH)
        {
            before = 0;
        }
        else
        {
            const rdv_f64 scale = 1.0 / z;

            to[0] = (((q[0] * ray->x) + (q[1] * ray->y)) + q[2]) * scale;
            to[1] = -(((q[3] * ray->x) + (q[4] * ray->y)) + q[5]) * scale;
            to[2] = nearly_atan2(to[1], to[0]) * per_radian;
            if (step > 0u)
            {
                reach_out(from, to, maxima);
            }
            from[0] = to[0];
            from[1] = to[1];
            from[2] = to[2];
        }
        step++;
    }
}

/* Circular mean over RDV_SMOOTH_BINS, an odd number, in whole readings. */
static void quantise(const rdv_f64 maxima[RDV_BINS], rdv_f64 scale, rdv_f32 readings[RDV_BINS])
{
    const uint32_t half = RDV_SMOOTH_BINS / 2u;
    const rdv_f64 factor = scale / (rdv_f64)((2u * half) + 1u);
    rdv_f64 running = 0.0;
    uint32_t k;

    for (k = 0u; k <= (2u * half); k++)
    {
        running += maxima[((RDV_BINS - half) + k) % RDV_BINS];
    }
    for (k = 0u; k < RDV_BINS; k++)
    {
        readings[k] = (rdv_f32)rint(running * factor);
        running += maxima[(k + half + 1u) % RDV_BINS] - maxima[((RDV_BINS - half) + k) % RDV_BINS];
    }
}

void rdv_rays(const rdv_pinhole *camera, rdv_point *points, uint32_t count)
{
    uint32_t i;

    for (i = 0u; i < count; i++)
    {
        points[i].x = (points[i].x - camera->cx) / camera->fx;
        points[i].y = (points[i].y - camera->cy) / camera->fy;
    }
}

static rdv_status check(const rdv_point *rays, const uint32_t *ends, uint32_t outlines)
{
    rdv_status status = RDV_OK;
    uint32_t start = 0u;
    uint32_t k;
    uint32_t i;

    for (k = 0u; k < outlines; k++)
    {
        if (ends[k] < start)
        {
            status = RDV_BAD_INPUT;
        }
        for (i = start; i < ends[k]; i++)
        {
            if (!(fabs(rays[i].x) <= MOST_TANGENT) || !(fabs(rays[i].y) <= MOST_TANGENT))
            {
                status = RDV_BAD_INPUT; /* NaN too */
            }
        }
        start = ends[k];
    }
    return status;
}

rdv_status rdv_signature_of(const rdv_point *rays, const uint32_t *ends, uint32_t outlines,
                            rdv_signature *signature)
{
    rdv_status status = RDV_BAD_INPUT;

    if ((rays != NULL) && (ends != NULL) && (signature != NULL))
    {
        status = check(rays, ends, outlines);
    }
    if (status == RDV_OK)
    {
        rdv_f64 total[3] = {0.0, 0.0, 0.0};
        uint32_t start = 0u;
        uint32_t k;

        for (k = 0u; k < outlines; k++)
        {
            add_vector_area(&rays[start], ends[k] - start, total);
            start = ends[k];
        }
        signature->area_sr =
            sqrt(((total[0] * total[0]) + (total[1] * total[1])) + (total[2] * total[2]));
        if (signature->area_sr > 0.0)
        {
            rdv_f64 maxima[RDV_BINS];

            turn_to_boresight(total, signature->centred_from_camera);
            for (k = 0u; k < RDV_BINS; k++)
            {
                maxima[k] = 0.0;
            }
            start = 0u;
            for (k = 0u; k < outlines; k++)
            {
                radial_maxima(&rays[start], ends[k] - start, signature->centred_from_camera,
                              maxima);
                start = ends[k];
            }
            quantise(maxima, UNIT / sqrt(signature->area_sr), signature->readings);
        }
        else
        {
            status = RDV_SMALL;
        }
    }
    return status;
}
