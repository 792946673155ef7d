/* Outer borders of the marked pixels, after Suzuki and Abe, without those of holes.
 *
 * The operations and their order are those of rendezview's own runtime, so that the outlines are
 * the same: keep them when the code is edited. */
#include <math.h>

#include "rendezview_frame.h"

const int32_t rdv_step_x[8] = {1, 1, 0, -1, -1, -1, 0, 1};
const int32_t rdv_step_y[8] = {0, 1, 1, 1, 0, -1, -1, -1};

void rdv_start_walk(const rdv_frame *frame, int32_t x, int32_t y, rdv_walker *walker)
{
    uint32_t turn = 1u;
    uint8_t found = 0u;

    walker->x = x;
    walker->y = y;
    /* clockwise from North-West: West is sky */
    while ((turn < 8u) && (found == 0u))
    {
        walker->back = (4u + turn) & 7u;
        walker->last_x = x + rdv_step_x[walker->back];
        walker->last_y = y + rdv_step_y[walker->back];
        found = (*rdv_mark_at(frame, walker->last_x, walker->last_y) != RDV_MARK_SKY) ? 1u : 0u;
        turn++;
    }
    walker->single = (found == 0u) ? 1u : 0u;
    walker->ahead = walker->back;
}

void rdv_look_ahead(const rdv_frame *frame, rdv_walker *walker)
{
    uint32_t turn = 1u;
    uint8_t found = 0u;

    while ((turn <= 8u) && (found == 0u))
    {
        walker->ahead = (walker->back + 8u - turn) & 7u;
        found = (*rdv_mark_at(frame, walker->x + rdv_step_x[walker->ahead],
                          walker->y + rdv_step_y[walker->ahead]) != RDV_MARK_SKY)
                    ? 1u
                    : 0u;
        turn++;
    }
}

uint8_t rdv_go_on(const rdv_blob *blob, rdv_walker *walker)
{
    const int32_t x = walker->x;
    const int32_t y = walker->y;
    uint8_t more = 1u;

    walker->x += rdv_step_x[walker->ahead];
    walker->y += rdv_step_y[walker->ahead];
    walker->back = (walker->ahead + 4u) & 7u;
    if ((walker->x == blob->x) && (walker->y == blob->y) && (x == walker->last_x) &&
        (y == walker->last_y))
    {
        more = 0u;
    }
    return more;
}

/* Follows a border, marks it, and measures the blob. */
static void measure(const rdv_frame *frame, rdv_blob *blob)
{
    rdv_walker walker;
    int64_t twice = 0;
    uint8_t more = 1u;

    blob->large = 0u;
    blob->chosen = 0u;
    blob->length = 0u;
    blob->left = blob->x;
    blob->right = blob->x;
    blob->top = blob->y;
    blob->bottom = blob->y;
    rdv_start_walk(frame, blob->x, blob->y, &walker);
    if (walker.single == 1u)
    {
        *rdv_mark_at(frame, blob->x, blob->y) = RDV_MARK_RIGHT;
        blob->length = 1u;
        more = 0u;
    }
    while (more == 1u)
    {
        uint8_t *const mark = rdv_mark_at(frame, walker.x, walker.y);
        const int32_t x = walker.x;
        const int32_t y = walker.y;
        uint32_t from_east;
        uint32_t last;

        rdv_look_ahead(frame, &walker);
        /* East was examined and is sky: the blob ends here */
        from_east = (8u - walker.ahead) & 7u;
        last = (8u - walker.back) & 7u;
        if ((from_east > 0u) && ((from_east - 1u) < last))
        {
            *mark = RDV_MARK_RIGHT;
        }
        else if (*mark == RDV_MARK_TARGET)
        {
            *mark = RDV_MARK_LEFT;
        }
        else
        {
            /* marked before */
        }
        blob->left = (x < blob->left) ? x : blob->left;
        blob->right = (x > blob->right) ? x : blob->right;
        blob->top = (y < blob->top) ? y : blob->top;
        blob->bottom = (y > blob->bottom) ? y : blob->bottom;
        blob->length++;
        more = rdv_go_on(blob, &walker);
        twice += ((int64_t)x * (int64_t)walker.y) - ((int64_t)walker.x * (int64_t)y);
    }
    /* Pick's theorem: pixels inside a lattice polygon and on it */
    blob->area = ((fabs((rdv_f64)twice) * 0.5) + (0.5 * (rdv_f64)blob->length)) + 1.0;
}

/* Keeps a blob; if there is no room, in place of the one with the shortest border. Blobs stay in
 * their order. `dropped` is the longest border of those left out that are more than a speck. */
static void keep(const rdv_blob *blob, rdv_blob blobs[RDV_MOST_BLOBS], uint32_t *count,
                 uint32_t *dropped)
{
    rdv_blob out = *blob;

    if (*count == RDV_MOST_BLOBS)
    {
        uint32_t shortest = 0u;
        uint32_t k;

        for (k = 1u; k < RDV_MOST_BLOBS; k++)
        {
            shortest = (blobs[k].length < blobs[shortest].length) ? k : shortest;
        }
        if (blob->length > blobs[shortest].length)
        {
            out = blobs[shortest];
            for (k = shortest; (k + 1u) < RDV_MOST_BLOBS; k++)
            {
                blobs[k] = blobs[k + 1u];
            }
            *count -= 1u;
        }
        if ((out.area >= RDV_LEAST_PART_PX) && (out.length > *dropped))
        {
            *dropped = out.length;
        }
    }
    if (*count < RDV_MOST_BLOBS)
    {
        blobs[*count] = *blob;
        *count += 1u;
    }
}

uint8_t rdv_find_blobs(const rdv_frame *frame, rdv_blob blobs[RDV_MOST_BLOBS], uint32_t *count)
{
    uint32_t longest = 0u;
    uint32_t dropped = 0u;
    int32_t x;
    int32_t y;

    *count = 0u;
    for (y = 0; y < frame->height; y++)
    {
        uint8_t before = RDV_MARK_SKY;
        uint8_t inside = 0u; /* right of a left edge: in a blob or in a hole of it */

        for (x = 0; x < frame->width; x++)
        {
            uint8_t mark = *rdv_mark_at(frame, x, y);

            if ((before == RDV_MARK_SKY) && (mark == RDV_MARK_TARGET) && (inside == 0u))
            {
                rdv_blob blob;

                blob.x = x;
                blob.y = y;
                measure(frame, &blob);
                longest = (blob.length > longest) ? blob.length : longest;
                keep(&blob, blobs, count, &dropped);
                mark = *rdv_mark_at(frame, x, y);
            }
            if (mark > RDV_MARK_TARGET)
            {
                inside = (mark == RDV_MARK_LEFT) ? 1u : 0u;
            }
            before = mark;
        }
    }
    return ((dropped == 0u) ||
            ((rdv_f64)(4u * dropped) < (RDV_LEAST_BORDER * (rdv_f64)longest)))
               ? 1u
               : 0u;
}
