/* Grey frame to outline: which blobs are the target, and the sub-pixel edge along them.
 *
 * The operations and their order are those of rendezview's own runtime, so that the outlines are
 * the same: keep them when the code is edited. */
#include <math.h>
#include <stddef.h>

#include "rendezview_frame.h"

#define BRIGHT_SKY 127.0
#define WHITE 255.0

const rdv_silhouette_options rdv_default_silhouette = {5.0, 4.0, 60.0, 0.0005, 0.15, 0.3, 2u};

/* ---- Which blobs are the target ---- */

static rdv_f64 outside(rdv_f64 value, int32_t least, int32_t most)
{
    return fmax(fmax((rdv_f64)least - value, value - (rdv_f64)most), 0.0);
}

static rdv_f64 distance_to(const rdv_point *point, const rdv_blob *blob)
{
    /* of two boxes around the point, use the one centred on it */
    const rdv_f64 off = hypot((0.5 * (rdv_f64)(blob->left + blob->right)) - point->x,
                              (0.5 * (rdv_f64)(blob->top + blob->bottom)) - point->y);

    return hypot(outside(point->x, blob->left, blob->right),
                 outside(point->y, blob->top, blob->bottom)) +
           (1e-3 * off);
}

static rdv_f64 gap(const rdv_silhouette_found *a, const rdv_blob *b)
{
    const int32_t aside = (a->left > b->right) ? (a->left - b->right) : (b->left - a->right);
    const int32_t above = (a->top > b->bottom) ? (a->top - b->bottom) : (b->top - a->bottom);
    const int32_t dx = (aside > 0) ? aside : 0;
    const int32_t dy = (above > 0) ? above : 0;

    return hypot((rdv_f64)dx, (rdv_f64)dy);
}

/* The largest blob, or of the bodies the one nearest to a place. Also which blobs are large. */
static uint32_t main_blob(rdv_blob blobs[RDV_MOST_BLOBS], uint32_t count,
                          const rdv_silhouette_options *options, const rdv_point *expected,
                          rdv_f64 *least_body)
{
    uint32_t longest = 0u;
    uint32_t largest = 0u;
    uint32_t result;
    uint32_t k;

    for (k = 0u; k < count; k++)
    {
        longest = (blobs[k].length > longest) ? blobs[k].length : longest;
    }
    for (k = 0u; k < count; k++)
    {
        blobs[k].chosen = 0u;
        blobs[k].large =
            ((rdv_f64)(4u * blobs[k].length) >= (RDV_LEAST_BORDER * (rdv_f64)longest)) ? 1u : 0u;
        if ((blobs[largest].large == 0u) ||
            ((blobs[k].large == 1u) && (blobs[k].area >= blobs[largest].area)))
        {
            largest = k;
        }
    }
    *least_body = options->rival_fraction * blobs[largest].area;
    result = largest;
    if (expected != NULL)
    {
        rdv_f64 nearest = HUGE_VAL;

        for (k = 0u; k < count; k++)
        {
            if ((blobs[k].large == 1u) && (blobs[k].area >= *least_body))
            {
                const rdv_f64 distance = distance_to(expected, &blobs[k]);

                if (distance <= nearest)
                {
                    nearest = distance;
                    result = k;
                }
            }
        }
    }
    return result;
}

/* Joins the blobs within reach of the target until none is left. The order of the
 * outlines, from below, is the runtime's. */
static void join(rdv_blob blobs[RDV_MOST_BLOBS], uint32_t count,
                 const rdv_silhouette_options *options, const rdv_blob *body, uint32_t *order,
                 rdv_silhouette_found *found)
{
    const int32_t width = body->right - body->left;
    const int32_t height = body->bottom - body->top;
    const rdv_f64 reach = options->merge_gap * (rdv_f64)((width > height) ? width : height);
    const rdv_f64 least = fmax(RDV_LEAST_PART_PX, options->speck_fraction * body->area);
    uint32_t before = 0u;

    while (before < found->outlines)
    {
        uint32_t k;

        before = found->outlines;
        for (k = count; k > 0u; k--)
        {
            const rdv_blob *const blob = &blobs[k - 1u];

            if ((blob->large == 1u) && (blob->chosen == 0u) && (blob->area >= least) &&
                (gap(found, blob) <= reach))
            {
                order[found->outlines] = k - 1u;
                found->outlines++;
            }
        }
        for (k = before; k < found->outlines; k++)
        {
            rdv_blob *const blob = &blobs[order[k]];

            blob->chosen = 1u;
            found->area_px += blob->area;
            found->left = (blob->left < found->left) ? blob->left : found->left;
            found->right = (blob->right > found->right) ? blob->right : found->right;
            found->top = (blob->top < found->top) ? blob->top : found->top;
            found->bottom = (blob->bottom > found->bottom) ? blob->bottom : found->bottom;
        }
    }
}

static rdv_status choose(const rdv_frame *frame, rdv_blob blobs[RDV_MOST_BLOBS], uint32_t count,
                         const rdv_silhouette_options *options, const rdv_point *expected,
                         uint32_t *order, rdv_silhouette_found *found)
{
    rdv_status status = RDV_OK;
    rdv_f64 least_body = 0.0;
    const uint32_t main_place = main_blob(blobs, count, options, expected, &least_body);
    rdv_blob *const body = &blobs[main_place];
    uint32_t rivals = 0u;
    uint32_t k;

    body->chosen = 1u;
    order[0] = main_place;
    found->outlines = 1u;
    found->area_px = body->area;
    found->left = body->left;
    found->right = body->right;
    found->top = body->top;
    found->bottom = body->bottom;
    join(blobs, count, options, body, order, found);
    for (k = 0u; k < count; k++)
    {
        if ((blobs[k].large == 1u) && (blobs[k].chosen == 0u) && (blobs[k].area >= least_body))
        {
            rivals++;
        }
    }
    if (body->area < options->least_area_px)
    {
        status = RDV_SMALL;
    }
    else if ((rivals > 0u) && (expected == NULL))
    {
        status = RDV_RIVALS;
    }
    else if ((found->left <= 0) || (found->top <= 0) || (found->right >= (frame->width - 1)) ||
             (found->bottom >= (frame->height - 1)))
    {
        const rdv_f64 whole = (rdv_f64)frame->width * (rdv_f64)frame->height;
        const rdv_f64 box = (rdv_f64)((found->right - found->left) + 1) *
                            (rdv_f64)((found->bottom - found->top) + 1);

        status = ((box > (0.95 * whole)) && (found->area_px > (0.9 * whole))) ? RDV_FULL
                                                                              : RDV_BORDER;
    }
    else
    {
        /* the target, whole */
    }
    return status;
}

/* ---- The edge between border pixels and their outer neighbours ---- */

static uint8_t in_frame(const rdv_frame *frame, int32_t x, int32_t y)
{
    return ((x >= 0) && (x < frame->width) && (y >= 0) && (y < frame->height)) ? 1u : 0u;
}

/* Distance from a border pixel outwards to the middle grey level of the edge; 0: there is none. */
static uint8_t edge_shift(const rdv_frame *frame, const rdv_walker *at, uint32_t direction,
                          const rdv_silhouette_found *found, uint32_t reach, rdv_f64 *shift)
{
    const int32_t dx = rdv_step_x[direction];
    const int32_t dy = rdv_step_y[direction];
    const int32_t here = rdv_grey_at(frame, at->x, at->y);
    int32_t best = here;
    int32_t step;
    uint8_t is_edge = 0u;

    for (step = 1; step <= (int32_t)reach; step++)
    {
        const int32_t x = at->x - (step * dx);
        const int32_t y = at->y - (step * dy);

        if ((in_frame(frame, x, y) == 1u) && (rdv_grey_at(frame, x, y) > best))
        {
            best = rdv_grey_at(frame, x, y);
        }
    }
    if ((rdv_f64)best >= (found->sky_grey + (found->level_grey - found->sky_grey)))
    {
        const rdv_f64 level = 0.5 * (found->sky_grey + (rdv_f64)best);
        rdv_f64 inner = (rdv_f64)here;

        if (in_frame(frame, at->x + dx, at->y + dy) == 0u)
        {
            *shift = 0.5;
            is_edge = 1u;
        }
        else
        {
            rdv_f64 outer = (rdv_f64)rdv_grey_at(frame, at->x + dx, at->y + dy);
            uint8_t more = 1u;

            step = 0;
            while (more == 1u)
            {
                if (inner >= level)
                {
                    *shift = (outer >= level)
                                 ? ((rdv_f64)(-step) + 0.99)
                                 : ((rdv_f64)(-step) + ((inner - level) / (inner - outer)));
                    is_edge = 1u;
                    more = 0u;
                }
                else
                {
                    const int32_t x = at->x - ((step + 1) * dx);
                    const int32_t y = at->y - ((step + 1) * dy);

                    step++;
                    if ((step > (int32_t)reach) || (in_frame(frame, x, y) == 0u))
                    {
                        more = 0u;
                    }
                    else
                    {
                        outer = inner;
                        inner = (rdv_f64)rdv_grey_at(frame, x, y);
                    }
                }
            }
        }
    }
    return is_edge;
}

/* Points of one blob's outline: each side of a border pixel that faces outside gives one. */
static uint8_t trace(const rdv_frame *frame, const rdv_blob *blob, uint32_t reach,
                     rdv_point *points, uint32_t most_points, uint32_t *count,
                     const rdv_silhouette_found *found)
{
    rdv_walker walker;
    uint8_t more = 1u;
    uint8_t room = 1u;

    rdv_start_walk(frame, blob->x, blob->y, &walker);
    while ((more == 1u) && (room == 1u))
    {
        uint32_t first = 6u; /* of a single pixel */
        uint32_t sides = 8u;
        uint32_t k;

        if (walker.single == 0u)
        {
            rdv_look_ahead(frame, &walker);
            first = (walker.back + 7u) & 7u;
            sides = (walker.back != walker.ahead) ? ((first + 8u - walker.ahead) & 7u) : 7u;
        }
        for (k = first & 1u; k < sides; k += 2u) /* corners give no point */
        {
            const uint32_t direction = (first + 8u - k) & 7u;
            rdv_f64 shift = 0.0;

            if (edge_shift(frame, &walker, direction, found, reach, &shift) == 1u)
            {
                if (*count < most_points)
                {
                    points[*count].x = (rdv_f64)walker.x + (shift * (rdv_f64)rdv_step_x[direction]);
                    points[*count].y = (rdv_f64)walker.y + (shift * (rdv_f64)rdv_step_y[direction]);
                    *count += 1u;
                }
                else
                {
                    room = 0u;
                }
            }
        }
        more = (walker.single == 1u) ? 0u : rdv_go_on(blob, &walker);
    }
    return room;
}

static rdv_status find(const rdv_frame *frame, const rdv_silhouette_options *options,
                       const rdv_point *expected, rdv_point *points, uint32_t most_points,
                       rdv_silhouette_found *found)
{
    rdv_status status = RDV_OK;
    rdv_blob blobs[RDV_MOST_BLOBS];
    uint32_t order[RDV_MOST_BLOBS];
    uint32_t count = 0u;

    rdv_mark_target(frame, found->level_grey);
    if (rdv_find_blobs(frame, blobs, &count) == 0u)
    {
        status = RDV_NO_ROOM;
    }
    else if (count == 0u)
    {
        status = (found->sky_grey > BRIGHT_SKY) ? RDV_FULL : RDV_EMPTY;
    }
    else
    {
        status = choose(frame, blobs, count, options, expected, order, found);
    }
    if (status == RDV_OK)
    {
        uint32_t used = 0u;
        uint32_t k;

        for (k = 0u; k < found->outlines; k++)
        {
            if (trace(frame, &blobs[order[k]], options->reach_px, points, most_points, &used,
                      found) == 0u)
            {
                status = RDV_NO_ROOM;
            }
            found->ends[k] = used;
        }
    }
    return status;
}

rdv_status rdv_silhouette(const uint8_t *grey, uint32_t width, uint32_t height,
                          const rdv_silhouette_options *options, const rdv_point *expected_px,
                          uint8_t *work, rdv_point *points, uint32_t most_points,
                          rdv_silhouette_found *found)
{
    rdv_status status = RDV_BAD_INPUT;

    if ((grey != NULL) && (options != NULL) && (work != NULL) && (points != NULL) &&
        (found != NULL) && (width >= RDV_LEAST_SIDE) && (width <= RDV_MOST_SIDE) &&
        (height >= RDV_LEAST_SIDE) && (height <= RDV_MOST_SIDE) &&
        (options->reach_px <= RDV_LEAST_SIDE))
    {
        const rdv_frame frame = {grey, work, (int32_t)width, (int32_t)height};
        rdv_f64 noise = 0.0;

        found->outlines = 0u;
        rdv_look_at_sky(&frame, &found->sky_grey, &noise);
        found->level_grey = found->sky_grey + fmax(options->noise_sigmas * noise,
                                                   options->least_contrast_grey);
        status = (found->level_grey >= WHITE)
                     ? RDV_FULL
                     : find(&frame, options, expected_px, points, most_points, found);
    }
    return status;
}
