// The rasteriser: one block per pixel tile and world.
//
// 1. Items (up to 32 clusters each) against the tile's frustum; a counting sort puts the survivors front to back.
// 2. Warps pull items. A cluster is skipped if everything in its rectangle is nearer (hierarchical z).
// 3. A warp projects a cluster's vertices into shared memory, one lane each; then every lane sets up two triangles.
// 4. Small triangles: the (triangle, pixel) pairs of all 64 are dealt out evenly to the lanes.
//    Large, thin, or near ones: homogeneous edge functions in double, the warp's lanes over the pixels. No near plane.
// 5. A 64-bit atomic minimum of (depth bits, word) keeps the nearest; ties go to the smaller word, so pictures repeat.

#ifndef TILE
#define TILE 64
#define WARPS 8
#define BLOCKS 4
#endif
#define THREADS (WARPS * 32)
#define COARSE (TILE / 8)
#define BUCKETS 128
#define BUCKETS_PER_M 8.f
#define NEAR_M 0.02f             // nearer vertices are left to the double path
#define SMALLEST_M 1e-4f         // as on the CPU: a plane through the eye itself is not seen
#define SMALL_PX 64.f            // so are longer triangles,
#define PERSPECTIVE 4.f          // those whose depths differ by more than this factor,
#define SLENDER 1024.f           // and those whose squared length exceeds so many times their doubled area
#define EXACT_TEST_PX 96         // rectangles up to so many pixels are tested pixel by pixel
#define BEHIND -2.f              // in place of 1/z: at or behind the eye's plane
#define TOO_NEAR -1.f
#define GENEROUS_PX 1e-4         // the double path's triangles are larger by this, against cracks

struct Raster {
    World world;
    float* depth;                // [views, height, width]; 0 = nothing
    u32* words;
};

struct Tile {
    float x0, y0, x1, y1;        // pixels
    float cx, cy;
    int width, height;
};

struct Rect {
    float near, x0, y0, x1, y1;  // nearest z [m]; pixels
};

struct Buffers {
    u64* pixels;                 // depth bits << 32 | word
    float* coarse;               // an upper bound of z in every 8x8 block
    float near;                  // what is nearer is cut away [m]
};

__device__ __forceinline__ void load_placement(const float* from, float* m) {
    const float4* rows = (const float4*)from;
    for (int r = 0; r < 3; r++) {
        float4 row = rows[r];
        m[4 * r] = row.x, m[4 * r + 1] = row.y, m[4 * r + 2] = row.z, m[4 * r + 3] = row.w;
    }
}

// Whether a box may be seen in the tile, and where. Whatever is NaN is not.
__device__ __forceinline__ bool visible(const float* m, float4 c, float4 h, const Tile& t, Rect& out) {
    float x = m[0] * c.x + m[1] * c.y + m[2] * c.z + m[3];
    float y = m[4] * c.x + m[5] * c.y + m[6] * c.z + m[7];
    float z = m[8] * c.x + m[9] * c.y + m[10] * c.z + m[11];
    float extent_z = fabsf(m[8]) * h.x + fabsf(m[9]) * h.y + fabsf(m[10]) * h.z;
    if (!(z + extent_z > 0.f)) return false;
    // the tile's four side planes
    const float slack = 1e-3f;
#define BEYOND(row, bound, value, sign)                                                                               \
    {                                                                                                                 \
        float b = bound;                                                                                              \
        float reach = fabsf(m[row] - b * m[8]) * h.x + fabsf(m[row + 1] - b * m[9]) * h.y                             \
            + fabsf(m[row + 2] - b * m[10]) * h.z;                                                                    \
        if (!(sign (value - b * z) + reach >= -slack)) return false;                                                  \
    }
    BEYOND(0, t.x0 - t.cx, x, +)
    BEYOND(0, t.x1 - t.cx, x, -)
    BEYOND(4, t.y0 - t.cy, y, +)
    BEYOND(4, t.y1 - t.cy, y, -)
#undef BEYOND
    out.near = (z - extent_z) * 0.99999f;
    if (out.near < NEAR_M) {     // at the eye: it may cover anything
        out = {0.f, t.x0, t.y0, t.x1, t.y1};
        return true;
    }
    float extent_x = fabsf(m[0]) * h.x + fabsf(m[1]) * h.y + fabsf(m[2]) * h.z;
    float extent_y = fabsf(m[4]) * h.x + fabsf(m[5]) * h.y + fabsf(m[6]) * h.z;
    float per_near = 1.f / out.near, per_far = 1.f / (z + extent_z);
    float left = x - extent_x, right = x + extent_x, top = y - extent_y, bottom = y + extent_y;
    const float margin = 0.05f;
    out.x0 = fmaxf(t.cx + left * (left > 0 ? per_far : per_near) - margin, t.x0);
    out.x1 = fminf(t.cx + right * (right > 0 ? per_near : per_far) + margin, t.x1);
    out.y0 = fmaxf(t.cy + top * (top > 0 ? per_far : per_near) - margin, t.y0);
    out.y1 = fminf(t.cy + bottom * (bottom > 0 ? per_near : per_far) + margin, t.y1);
    return out.x0 <= out.x1 && out.y0 <= out.y1;
}

__device__ __forceinline__ int row_of(int k, float per_width) { return (int)(((float)k + 0.5f) * per_width); }

// Whether no pixel centre of the rectangle is further than its nearest z. All lanes give the same arguments.
__device__ __forceinline__ bool hidden(const Buffers& b, const Tile& t, const Rect& r, int lane) {
    int x0 = max(0, (int)ceilf(r.x0 - t.x0 - 0.5f)), x1 = (int)floorf(fminf(r.x1, t.x1 - 0.25f) - t.x0 - 0.5f);
    int y0 = max(0, (int)ceilf(r.y0 - t.y0 - 0.5f)), y1 = (int)floorf(fminf(r.y1, t.y1 - 0.25f) - t.y0 - 0.5f);
    int w = x1 - x0 + 1, h = y1 - y0 + 1;
    if (w <= 0 || h <= 0) return true;
    bool seen = false;
    if (w * h <= EXACT_TEST_PX) {
        const volatile u32* halves = (const volatile u32*)b.pixels;
        u32 near = __float_as_uint(r.near);
        float per_width = __frcp_rn((float)w);
        for (int k = lane; k < w * h; k += 32) {
            int y = row_of(k, per_width), x = k - y * w;
            seen |= halves[2 * ((y0 + y) * TILE + x0 + x) + 1] >= near;
        }
    } else {
        const volatile float* coarse = b.coarse;
        x0 >>= 3, y0 >>= 3;
        w = (x1 >> 3) - x0 + 1, h = (y1 >> 3) - y0 + 1;
        float per_width = __frcp_rn((float)w);
        for (int k = lane; k < w * h; k += 32) {
            int y = row_of(k, per_width), x = k - y * w;
            seen |= coarse[(y0 + y) * COARSE + x0 + x] >= r.near;
        }
    }
    return !__any_sync(FULL, seen);
}

__device__ __forceinline__ void blend(const Buffers& b, int x, int y, float z, u32 word) {
    u64* pixel = b.pixels + y * TILE + x;
    u32 depth = __float_as_uint(z);
    if (depth <= ((volatile u32*)pixel)[1] && z >= b.near) atomicMin(pixel, (u64)depth << 32 | word);
}

// One triangle by the whole warp: homogeneous edge functions (Olano & Greer 1997), set up in double.
// Not inlined, and given the matrix where it lies in memory, so that it costs the others no registers.
__device__ __noinline__ void draw_exactly(
    Buffers b, float tile_x, float tile_y, const float* m, const float* vertices, u32 triangle, u32 place, u32 word,
    int lane
) {
    int4 box = make_int4(place & 255, (place >> 8) & 255, (place >> 16) & 255, place >> 24);
    double p[3][3];
    for (int j = 0; j < 3; j++) {
        const float* v = vertices + 3 * ((triangle >> (8 * j)) & 255);
        for (int r = 0; r < 3; r++)
            p[j][r] = (double)m[4 * r] * v[0] + (double)m[4 * r + 1] * v[1] + (double)m[4 * r + 2] * v[2] + m[4 * r + 3];
    }
    // the rows of the inverse of [p0 p1 p2] give each barycentric over z as a linear function of the ray
    double e[3][3], s[3], u[3];
    for (int j = 0; j < 3; j++) {
        const double *q = p[(j + 1) % 3], *r = p[(j + 2) % 3];
        e[j][0] = q[1] * r[2] - q[2] * r[1];
        e[j][1] = q[2] * r[0] - q[0] * r[2];
        e[j][2] = q[0] * r[1] - q[1] * r[0];
        s[j] = p[1][j] - p[0][j];
        u[j] = p[2][j] - p[0][j];
    }
    double determinant = p[0][0] * e[0][0] + p[0][1] * e[0][1] + p[0][2] * e[0][2];
    if (determinant == 0.) return;
    double k = 1. / determinant;
    double ray_x = (double)tile_x + box.x + 0.5, ray_y = (double)tile_y + box.y + 0.5;
    double w_x = (s[1] * u[2] - s[2] * u[1]) * k, w_y = (s[2] * u[0] - s[0] * u[2]) * k;
    double w = w_x * ray_x + w_y * ray_y + (s[0] * u[1] - s[1] * u[0]) * k;
    float edge[3], edge_x[3], edge_y[3];
    float far_x = (float)(box.z - 1), far_y = (float)(box.w - 1);
    bool outside = false;
    for (int j = 0; j < 3; j++) {
        double dx = e[j][0] * k, dy = e[j][1] * k;
        edge_x[j] = (float)dx;
        edge_y[j] = (float)dy;
        edge[j] = (float)(dx * ray_x + dy * ray_y + e[j][2] * k + GENEROUS_PX * (fabs(dx) + fabs(dy)));
        outside |= edge[j] + fmaxf(edge_x[j], 0.f) * far_x + fmaxf(edge_y[j], 0.f) * far_y < 0.f;
    }
    if (outside) return;
    float per_width = __frcp_rn((float)box.z);
    for (int i = lane; i < box.z * box.w; i += 32) {
        int y = row_of(i, per_width), x = i - y * box.z;
        float fx = (float)x, fy = (float)y;
        float e0 = fmaf(edge_x[0], fx, fmaf(edge_y[0], fy, edge[0]));
        float e1 = fmaf(edge_x[1], fx, fmaf(edge_y[1], fy, edge[1]));
        float e2 = fmaf(edge_x[2], fx, fmaf(edge_y[2], fy, edge[2]));
        if (!(fminf(fminf(e0, e1), e2) >= 0.f)) continue;
        float inverse = (float)(w + w_x * fx + w_y * fy);
        if (inverse > 0.f) blend(b, box.x + x, box.y + y, __frcp_rn(inverse), word);
    }
}

// Setting up a triangle: its pixel box (x, y, width, height; tile-relative; no area = nothing to draw) and its path.
__device__ __forceinline__ int4 set_up(const float* corners, u32 triangle, const Tile& t, bool& exactly) {
    const float *a = corners + 3 * (triangle & 255), *b = corners + 3 * ((triangle >> 8) & 255),
                *c = corners + 3 * ((triangle >> 16) & 255);
    float smallest = fminf(fminf(a[2], b[2]), c[2]), largest = fmaxf(fmaxf(a[2], b[2]), c[2]);
    exactly = false;
    if (smallest <= 0.f) {
        exactly = largest > BEHIND;  // something of it is in front of the eye
        return exactly ? make_int4(0, 0, t.width, t.height) : make_int4(0, 0, 0, 0);
    }
    float left = fminf(fminf(a[0], b[0]), c[0]), right = fmaxf(fmaxf(a[0], b[0]), c[0]);
    float top = fminf(fminf(a[1], b[1]), c[1]), bottom = fmaxf(fmaxf(a[1], b[1]), c[1]);
    const float margin = 2e-3f;
    int x0 = max(0, (int)ceilf(fmaxf(left - margin, -1.f)));
    int x1 = min(t.width - 1, (int)floorf(fminf(right + margin, TILE)));
    int y0 = max(0, (int)ceilf(fmaxf(top - margin, -1.f)));
    int y1 = min(t.height - 1, (int)floorf(fminf(bottom + margin, TILE)));
    if (x1 < x0 || y1 < y0) return make_int4(0, 0, 0, 0);
    float abx = b[0] - a[0], aby = b[1] - a[1], acx = c[0] - a[0], acy = c[1] - a[1];
    float area = fabsf(abx * acy - acx * aby), across = right - left, down = bottom - top;
    exactly = fmaxf(across, down) > SMALL_PX || largest > PERSPECTIVE * smallest
        || across * across + down * down > SLENDER * area;
    return make_int4(x0, y0, x1 - x0 + 1, y1 - y0 + 1);
}

// One pixel of a small triangle. The products are rounded alike for both triangles at an edge: no cracks.
__device__ __forceinline__ void draw_pixel(
    const Buffers& buffers, const float* corners, u32 triangle, int x, int y, u32 word
) {
    const float *a = corners + 3 * (triangle & 255), *b = corners + 3 * ((triangle >> 8) & 255),
                *c = corners + 3 * ((triangle >> 16) & 255);
    float px = (float)x, py = (float)y;
    float ax = a[0] - px, ay = a[1] - py, bx = b[0] - px, by = b[1] - py, cx = c[0] - px, cy = c[1] - py;
    float ea = __fsub_rn(__fmul_rn(bx, cy), __fmul_rn(by, cx));
    float eb = __fsub_rn(__fmul_rn(cx, ay), __fmul_rn(cy, ax));
    float ec = __fsub_rn(__fmul_rn(ax, by), __fmul_rn(ay, bx));
    bool inside = (fminf(fminf(ea, eb), ec) >= 0.f) | (fmaxf(fmaxf(ea, eb), ec) <= 0.f);
    float sum = ea + eb + ec;
    if (inside && sum != 0.f) blend(buffers, x, y, __fdividef(sum, ea * a[2] + eb * b[2] + ec * c[2]), word);
}

// A cluster by one warp.
__device__ __forceinline__ void draw_cluster(
    const Buffers& buffers, const Tile& t, const float* m, const float* placement, const float* vertices, int vertex_count,
    const u32* triangles, int triangle_count, float* corners, u32 first_word, int lane
) {
    const float center_x = t.cx - t.x0 - 0.5f, center_y = t.cy - t.y0 - 0.5f;  // pixel centres become whole numbers
    __syncwarp();
    for (int i = lane; i < vertex_count; i += 32) {
        float vx = vertices[3 * i], vy = vertices[3 * i + 1], vz = vertices[3 * i + 2];
        float x = m[0] * vx + m[1] * vy + m[2] * vz + m[3];
        float y = m[4] * vx + m[5] * vy + m[6] * vz + m[7];
        float z = m[8] * vx + m[9] * vy + m[10] * vz + m[11];
        float inverse = z > 0.f ? TOO_NEAR : BEHIND;
        if (z >= NEAR_M) {
            inverse = __frcp_rn(z);
            corners[3 * i] = x * inverse + center_x;
            corners[3 * i + 1] = y * inverse + center_y;
        }
        corners[3 * i + 2] = inverse;
    }
    __syncwarp();
    u32 triangle[2], box[2];
    int pairs[2];
    bool exact[2];
#pragma unroll
    for (int r = 0; r < 2; r++) {
        int i = r * 32 + lane;
        int4 b = make_int4(0, 0, 0, 0);
        triangle[r] = 0;
        exact[r] = false;
        if (i < triangle_count) {
            triangle[r] = triangles[i];
            b = set_up(corners, triangle[r], t, exact[r]);
        }
        box[r] = b.x | b.y << 8 | b.z << 16 | b.w << 24;
        pairs[r] = exact[r] ? 0 : b.z * b.w;
    }
    int own = pairs[0] + pairs[1];
    if (__any_sync(FULL, own)) {
        int upto = own;
#pragma unroll
        for (int step = 1; step < 32; step <<= 1) {
            int before = __shfl_up_sync(FULL, upto, step);
            if (lane >= step) upto += before;
        }
        int total = __shfl_sync(FULL, upto, 31), from = upto - own;
        for (int start = 0; start < total; start += 32) {
            int pair = start + lane, owner = 0;
#pragma unroll
            for (int step = 16; step; step >>= 1)  // the first lane whose pairs go beyond this one
                if (__shfl_sync(FULL, upto, owner + step - 1) <= pair) owner += step;
            owner = min(owner, 31);
            int k = pair - __shfl_sync(FULL, from, owner), first_pairs = __shfl_sync(FULL, pairs[0], owner);
            u32 chosen = __shfl_sync(FULL, triangle[0], owner), other = __shfl_sync(FULL, triangle[1], owner);
            u32 place = __shfl_sync(FULL, box[0], owner), other_place = __shfl_sync(FULL, box[1], owner);
            int number = owner;
            if (k >= first_pairs) {
                k -= first_pairs;
                chosen = other;
                place = other_place;
                number += 32;
            }
            if (pair < total) {
                int width = (place >> 16) & 255, y = row_of(k, __frcp_rn((float)width)), x = k - y * width;
                draw_pixel(buffers, corners, chosen, x + (place & 255), y + ((place >> 8) & 255), first_word + number);
            }
        }
    }
#pragma unroll
    for (int r = 0; r < 2; r++)
        for (u32 waiting = __ballot_sync(FULL, exact[r]); waiting; waiting &= waiting - 1) {
            int owner = __ffs(waiting) - 1;
            u32 chosen = __shfl_sync(FULL, triangle[r], owner), place = __shfl_sync(FULL, box[r], owner);
            draw_exactly(buffers, t.x0 - t.cx, t.y0 - t.cy, placement, vertices, chosen, place,
                         first_word + r * 32 + owner, lane);
        }
}

// Take the bound of the coarse blocks under a rectangle anew.
__device__ __forceinline__ void refresh(const Buffers& b, const Tile& t, const Rect& r, int lane) {
    __syncwarp();
    int x0 = max(0, (int)((r.x0 - t.x0) * 0.125f)), x1 = min((t.width - 1) >> 3, (int)((r.x1 - t.x0) * 0.125f));
    int y0 = max(0, (int)((r.y0 - t.y0) * 0.125f)), y1 = min((t.height - 1) >> 3, (int)((r.y1 - t.y0) * 0.125f));
    const volatile u32* halves = (const volatile u32*)b.pixels;
    for (int j = y0; j <= y1; j++)
        for (int i = x0; i <= x1; i++) {
            int x = i * 8 + (lane & 7), y = j * 8 + (lane >> 3);
            u32 z = 0;
            if (x < t.width && y < t.height) z = halves[2 * (y * TILE + x) + 1];
            if (x < t.width && y + 4 < t.height) {
                u32 below = halves[2 * ((y + 4) * TILE + x) + 1];
                z = max(z, below);
            }
            z = __reduce_max_sync(FULL, z);
            if (lane == 0) b.coarse[j * COARSE + i] = __uint_as_float(z);
        }
}

__device__ __forceinline__ Rect shared_rect(const Rect& r, int lane) {
    return {__shfl_sync(FULL, r.near, lane), __shfl_sync(FULL, r.x0, lane), __shfl_sync(FULL, r.y0, lane),
            __shfl_sync(FULL, r.x1, lane), __shfl_sync(FULL, r.y1, lane)};
}

extern "C" __global__ void __launch_bounds__(THREADS, BLOCKS) raster(Raster f) {
    extern __shared__ u64 shared[];
    __shared__ int found, next, histogram[BUCKETS];
    const World& s = f.world;
    int tid = threadIdx.x, lane = tid & 31, warp = tid >> 5;
    int across = (s.width + TILE - 1) / TILE, tiles = across * ((s.height + TILE - 1) / TILE);
    int tile = blockIdx.x % tiles, local = blockIdx.x / tiles, view = s.first_view + local, world = s.world_of_view[view];
    const Scene scene = s.scenes[s.scene_of_world[world]];
    const float* camera = s.cameras + CAMERA_WORDS * (size_t)view;
    u32 hidden_layers = s.hidden[view];
    Tile t;
    t.x0 = (tile % across) * TILE, t.y0 = (tile / across) * TILE;
    t.x1 = fminf(t.x0 + TILE, s.width), t.y1 = fminf(t.y0 + TILE, s.height);
    t.cx = camera[14] * s.scale, t.cy = camera[15] * s.scale;
    t.width = (int)(t.x1 - t.x0), t.height = (int)(t.y1 - t.y0);

    Buffers buffers = {shared, (float*)(shared + TILE * TILE), fmaxf(camera[16], SMALLEST_M)};
    float* corners = buffers.coarse + COARSE * COARSE + warp * CLUSTER_VERTICES * 3;
    u32* list = (u32*)(buffers.coarse + COARSE * COARSE + WARPS * CLUSTER_VERTICES * 3);  // bucket << 16 | item
    unsigned short* sorted = (unsigned short*)(list + scene.items);
    const float far = camera[17];
    for (int i = tid; i < TILE * TILE; i += THREADS) buffers.pixels[i] = (u64)__float_as_uint(far) << 32 | NOTHING;
    for (int i = tid; i < COARSE * COARSE; i += THREADS)
        buffers.coarse[i] = (i % COARSE) * 8 < t.width && (i / COARSE) * 8 < t.height ? far : 0.f;
    for (int i = tid; i < BUCKETS; i += THREADS) histogram[i] = 0;
    if (tid == 0) found = next = 0;
    __syncthreads();

    // cull and sort
    const float* placement = s.placement + (size_t)view * s.slots * 12;
    auto load_item = [&](int item, float* m, Place& place, Box& box) {
        place = s.places[scene.first_item + item];
        load_placement(placement + 12 * place.slot, m);
        box = place.group < 0 ? s.items[scene.first_item + item]
                              : s.deformed_groups[(size_t)world * s.deformed_group_count + place.group];
    };
    float m[12];
    Place place;
    Box box;
    Rect rect;
    for (int item = tid; item < scene.items; item += THREADS) {
        load_item(item, m, place, box);
        if (place.layer & hidden_layers || !visible(m, box.center, box.half, t, rect)) continue;
        int bucket = min(BUCKETS - 1, (int)(rect.near * BUCKETS_PER_M));
        list[atomicAdd(&found, 1)] = (u32)bucket << 16 | item;
        atomicAdd(histogram + bucket, 1);
    }
    __syncthreads();
    int count = found;
    if (warp == 0) {  // an exclusive sum
        int sum = 0, own[BUCKETS / 32];
        for (int i = 0; i < BUCKETS / 32; i++) sum += own[i] = histogram[lane * (BUCKETS / 32) + i];
        int upto = sum;
        for (int step = 1; step < 32; step <<= 1) {
            int before = __shfl_up_sync(FULL, upto, step);
            if (lane >= step) upto += before;
        }
        upto -= sum;
        for (int i = 0; i < BUCKETS / 32; i++) {
            histogram[lane * (BUCKETS / 32) + i] = upto;
            upto += own[i];
        }
    }
    __syncthreads();
    for (int i = tid; i < count; i += THREADS) sorted[atomicAdd(histogram + (list[i] >> 16), 1)] = list[i] & 0xffff;
    __syncthreads();

    // draw
    while (true) {
        int turn = 0;
        if (lane == 0) turn = atomicAdd(&next, 1);
        turn = __shfl_sync(FULL, turn, 0);
        if (turn >= count) break;
        int item = sorted[turn];
        load_item(item, m, place, box);
        visible(m, box.center, box.half, t, rect);
        if (hidden(buffers, t, rect, lane)) continue;
        int first = bits(box.center.w), clusters = bits(box.half.w);
        const Box* boxes = place.group < 0
            ? s.clusters : s.deformed_clusters + (size_t)world * s.deformed_cluster_count - scene.first_cluster;
        const float* vertices = vertices_of(s, scene, world, place.group);
        float4 center = make_float4(0, 0, 0, 0), half = center;
        bool waiting = false, drawn = false;
        Rect own = {0, 0, 0, 0, 0}, covered = {0, t.x1, t.y1, t.x0, t.y0};
        if (lane < clusters) {
            center = boxes[first + lane].center;
            half = boxes[first + lane].half;
            waiting = visible(m, center, half, t, own);
        }
        for (u32 left = __ballot_sync(FULL, waiting); left;) {
            u32 key = waiting ? __float_as_uint(own.near) : 0xffffffffu;  // the nearest first
            int chosen = __ffs(__ballot_sync(FULL, key == __reduce_min_sync(FULL, key))) - 1;
            left &= ~(1u << chosen);
            if (lane == chosen) waiting = false;
            Rect r = shared_rect(own, chosen);
            if (hidden(buffers, t, r, lane)) continue;
            drawn = true;
            covered = {0, fminf(covered.x0, r.x0), fminf(covered.y0, r.y0), fmaxf(covered.x1, r.x1),
                       fmaxf(covered.y1, r.y1)};
            int counts = bits(__shfl_sync(FULL, center.w, chosen)), vertex = bits(__shfl_sync(FULL, half.w, chosen));
            draw_cluster(buffers, t, m, placement + 12 * place.slot, vertices + 3 * (size_t)vertex, counts & 0xffff,
                         s.triangles + (size_t)(first + chosen) * CLUSTER_TRIANGLES, counts >> 16, corners,
                         (u32)item << 11 | chosen << 6, lane);
        }
        if (drawn) refresh(buffers, t, covered, lane);
    }
    __syncthreads();
    for (int i = tid; i < TILE * TILE; i += THREADS) {
        int x = i % TILE, y = i / TILE;
        if (x >= t.width || y >= t.height) continue;
        size_t at = ((size_t)local * s.height + (int)t.y0 + y) * s.width + (int)t.x0 + x;
        u32 word = (u32)buffers.pixels[i];
        f.depth[at] = word == NOTHING ? 0.f : __uint_as_float((u32)(buffers.pixels[i] >> 32));
        f.words[at] = word;
    }
}
