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
#define COARSE_WORDS ((COARSE * COARSE + 3) / 4 * 4)
#define BUCKETS 128
#define BUCKETS_PER_M 8.f
#define NEAR_M 0.02f             // nearer vertices are left to the double path
#define SMALLEST_M 1e-4f         // as on the CPU: a plane through the eye itself is not seen
#define LARGE_PX 512             // so are triangles whose box in the tile has so many pixels,
#define SLENDER_M 150.f          // and those whose squared length times their depth exceeds this times their doubled area
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
    float cx, cy;                // principal point, from the tile's corner [px]; so are all pixels below
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

struct Scratch {                 // of a warp
    float4 corners[CLUSTER_VERTICES];    // x, y [px] from the first pixel's centre, 1/z
    uint2 triangles[CLUSTER_TRIANGLES];  // three vertices; box: x, y, width, height
};

__device__ __forceinline__ float fast_inverse(float x) { return __fdividef(1.f, x); }

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
    BEYOND(0, -t.cx, x, +)
    BEYOND(0, t.width - t.cx, x, -)
    BEYOND(4, -t.cy, y, +)
    BEYOND(4, t.height - t.cy, y, -)
#undef BEYOND
    out.near = (z - extent_z) * 0.99999f;
    if (out.near < NEAR_M) {     // at the eye: it may cover anything
        out = {0.f, 0.f, 0.f, (float)t.width, (float)t.height};
        return true;
    }
    float extent_x = fabsf(m[0]) * h.x + fabsf(m[1]) * h.y + fabsf(m[2]) * h.z;
    float extent_y = fabsf(m[4]) * h.x + fabsf(m[5]) * h.y + fabsf(m[6]) * h.z;
    float per_near = fast_inverse(out.near), per_far = fast_inverse(z + extent_z);
    float left = x - extent_x, right = x + extent_x, top = y - extent_y, bottom = y + extent_y;
    const float margin = 0.05f;
    out.x0 = fmaxf(t.cx + left * (left > 0 ? per_far : per_near) - margin, 0.f);
    out.x1 = fminf(t.cx + right * (right > 0 ? per_near : per_far) + margin, (float)t.width);
    out.y0 = fmaxf(t.cy + top * (top > 0 ? per_far : per_near) - margin, 0.f);
    out.y1 = fminf(t.cy + bottom * (bottom > 0 ? per_near : per_far) + margin, (float)t.height);
    return out.x0 <= out.x1 && out.y0 <= out.y1;
}

__device__ __forceinline__ int row_of(int k, float per_width) { return (int)(((float)k + 0.5f) * per_width); }

// Whether no pixel centre of the rectangle is further than its nearest z. All lanes give the same arguments.
__device__ __forceinline__ bool hidden(const Buffers& b, const Tile& t, const Rect& r, int lane) {
    int x0 = max(0, (int)ceilf(r.x0 - 0.5f)), x1 = min(t.width - 1, (int)floorf(r.x1 - 0.5f));
    int y0 = max(0, (int)ceilf(r.y0 - 0.5f)), y1 = min(t.height - 1, (int)floorf(r.y1 - 0.5f));
    int w = x1 - x0 + 1, h = y1 - y0 + 1;
    if (w <= 0 || h <= 0) return true;
    bool seen = false;
    if (w * h <= EXACT_TEST_PX) {
        const volatile u32* halves = (const volatile u32*)b.pixels;
        u32 near = __float_as_uint(r.near);
        float per_width = fast_inverse((float)w);
        for (int k = lane; k < w * h; k += 32) {
            int y = row_of(k, per_width), x = k - y * w;
            seen |= halves[2 * ((y0 + y) * TILE + x0 + x) + 1] >= near;
        }
    } else {
        const volatile float* coarse = b.coarse;
        x0 >>= 3, y0 >>= 3;
        w = (x1 >> 3) - x0 + 1, h = (y1 >> 3) - y0 + 1;
        float per_width = fast_inverse((float)w);
        for (int k = lane; k < w * h; k += 32) {
            int y = row_of(k, per_width), x = k - y * w;
            seen |= coarse[(y0 + y) * COARSE + x0 + x] >= r.near;
        }
    }
    return !__any_sync(FULL, seen);
}

// The same for a lane's own rectangle, if it is small: only the coarse blocks, and false if in doubt.
__device__ __forceinline__ bool hidden_coarsely(const Buffers& b, const Tile& t, const Rect& r) {
    int x0 = (int)(r.x0 * 0.125f), x1 = min((t.width - 1) >> 3, (int)(r.x1 * 0.125f));
    int y0 = (int)(r.y0 * 0.125f), y1 = min((t.height - 1) >> 3, (int)(r.y1 * 0.125f));
    if (x1 - x0 > 2 || y1 - y0 > 2) return false;
    const volatile float* coarse = b.coarse;
    for (int y = y0; y <= y1; y++)
        for (int x = x0; x <= x1; x++)
            if (coarse[y * COARSE + x] >= r.near) return false;
    return true;
}

__device__ __forceinline__ void blend(const Buffers& b, int x, int y, float z, u32 word) {
    u64* pixel = b.pixels + y * TILE + x;
    u32 depth = __float_as_uint(z);
    if (depth <= ((volatile u32*)pixel)[1] && z >= b.near) atomicMin(pixel, (u64)depth << 32 | word);
}

// Triangles by homogeneous edge functions (Olano & Greer 1997): every lane sets up its own, if `exact`, in double; then the
// whole warp draws one after another. Not inlined, and given the matrix where it lies in memory: so it costs the caller no
// registers.
__device__ __noinline__ void draw_exactly(
    Buffers b, float center_x, float center_y, const float* m, const float* vertices, const uint2* triangles, bool exact,
    int number, u32 first_word, int lane
) {
    float edge[3], edge_x[3], edge_y[3];
    double w = 0., w_x = 0., w_y = 0.;
    if (exact) {
        u32 triangle = triangles[number].x, place = triangles[number].y;
        double p[3][3], e[3][3], s[3], u[3];
        for (int j = 0; j < 3; j++) {
            const float* v = vertices + 3 * ((triangle >> (8 * j)) & 255);
            for (int r = 0; r < 3; r++)
                p[j][r] = (double)m[4 * r] * v[0] + (double)m[4 * r + 1] * v[1] + (double)m[4 * r + 2] * v[2] + m[4 * r + 3];
        }
        // the rows of the inverse of [p0 p1 p2] give each barycentric over z as a linear function of the ray
        for (int j = 0; j < 3; j++) {
            const double *q = p[(j + 1) % 3], *r = p[(j + 2) % 3];
            e[j][0] = q[1] * r[2] - q[2] * r[1];
            e[j][1] = q[2] * r[0] - q[0] * r[2];
            e[j][2] = q[0] * r[1] - q[1] * r[0];
            s[j] = p[1][j] - p[0][j];
            u[j] = p[2][j] - p[0][j];
        }
        double determinant = p[0][0] * e[0][0] + p[0][1] * e[0][1] + p[0][2] * e[0][2];
        exact = determinant != 0.;
        double k = 1. / determinant;
        double ray_x = (place & 255) + 0.5 - center_x, ray_y = ((place >> 8) & 255) + 0.5 - center_y;
        w_x = (s[1] * u[2] - s[2] * u[1]) * k;
        w_y = (s[2] * u[0] - s[0] * u[2]) * k;
        w = w_x * ray_x + w_y * ray_y + (s[0] * u[1] - s[1] * u[0]) * k;
        float far_x = (float)((place >> 16) & 255) - 1.f, far_y = (float)(place >> 24) - 1.f;
        for (int j = 0; j < 3; j++) {
            double dx = e[j][0] * k, dy = e[j][1] * k;
            edge_x[j] = (float)dx;
            edge_y[j] = (float)dy;
            edge[j] = (float)(dx * ray_x + dy * ray_y + e[j][2] * k + GENEROUS_PX * (fabs(dx) + fabs(dy)));
            if (edge[j] + fmaxf(edge_x[j], 0.f) * far_x + fmaxf(edge_y[j], 0.f) * far_y < 0.f) exact = false;
        }
    }
    for (u32 waiting = __ballot_sync(FULL, exact); waiting; waiting &= waiting - 1) {
        int owner = __ffs(waiting) - 1, one = __shfl_sync(FULL, number, owner);
        u32 place = triangles[one].y;
        float e[3], e_x[3], e_y[3];
        for (int j = 0; j < 3; j++) {
            e[j] = __shfl_sync(FULL, edge[j], owner);
            e_x[j] = __shfl_sync(FULL, edge_x[j], owner);
            e_y[j] = __shfl_sync(FULL, edge_y[j], owner);
        }
        double z = __shfl_sync(FULL, w, owner), z_x = __shfl_sync(FULL, w_x, owner), z_y = __shfl_sync(FULL, w_y, owner);
        int x0 = place & 255, y0 = (place >> 8) & 255, width = (place >> 16) & 255, height = place >> 24;
        float per_width = fast_inverse((float)width);
        for (int i = lane; i < width * height; i += 32) {
            int y = row_of(i, per_width), x = i - y * width;
            float fx = (float)x, fy = (float)y;
            float e0 = fmaf(e_x[0], fx, fmaf(e_y[0], fy, e[0]));
            float e1 = fmaf(e_x[1], fx, fmaf(e_y[1], fy, e[1]));
            float e2 = fmaf(e_x[2], fx, fmaf(e_y[2], fy, e[2]));
            if (!(fminf(fminf(e0, e1), e2) >= 0.f)) continue;
            float inverse = (float)(z + z_x * fx + z_y * fy);
            if (inverse > 0.f) blend(b, x0 + x, y0 + y, __frcp_rn(inverse), first_word + one);
        }
    }
}

// Setting up a triangle: its pixel box (x, y, width, height; tile-relative; no area = nothing to draw) and its path.
__device__ __forceinline__ int4 set_up(const float4* corners, u32 triangle, const Tile& t, bool& exactly) {
    float4 a = corners[triangle & 255], b = corners[(triangle >> 8) & 255], c = corners[(triangle >> 16) & 255];
    float smallest = fminf(fminf(a.z, b.z), c.z), largest = fmaxf(fmaxf(a.z, b.z), c.z);
    exactly = false;
    if (smallest <= 0.f) {
        exactly = largest > BEHIND;  // something of it is in front of the eye
        return exactly ? make_int4(0, 0, t.width, t.height) : make_int4(0, 0, 0, 0);
    }
    float left = fminf(fminf(a.x, b.x), c.x), right = fmaxf(fmaxf(a.x, b.x), c.x);
    float top = fminf(fminf(a.y, b.y), c.y), bottom = fmaxf(fmaxf(a.y, b.y), c.y);
    const float margin = 2e-3f;
    int x0 = max(0, (int)ceilf(fmaxf(left - margin, -1.f)));
    int x1 = min(t.width - 1, (int)floorf(fminf(right + margin, TILE)));
    int y0 = max(0, (int)ceilf(fmaxf(top - margin, -1.f)));
    int y1 = min(t.height - 1, (int)floorf(fminf(bottom + margin, TILE)));
    if (x1 < x0 || y1 < y0) return make_int4(0, 0, 0, 0);
    float area = fabsf((b.x - a.x) * (c.y - a.y) - (c.x - a.x) * (b.y - a.y)), across = right - left, down = bottom - top;
    int width = x1 - x0 + 1, height = y1 - y0 + 1;
    // what rounding may do to a depth is about 1e-7 times squared length over area, times the triangle's depth
    exactly = width * height >= LARGE_PX
        || (across * across + down * down) * (largest - smallest) > SLENDER_M * area * smallest * largest;
    return make_int4(x0, y0, width, height);
}

// One pixel of a small triangle. The products are rounded alike for both triangles at an edge: no cracks.
__device__ __forceinline__ void draw_pixel(
    const Buffers& buffers, const float4* corners, u32 triangle, int x, int y, u32 word
) {
    float4 a = corners[triangle & 255], b = corners[(triangle >> 8) & 255], c = corners[(triangle >> 16) & 255];
    float px = (float)x, py = (float)y;
    float ax = a.x - px, ay = a.y - py, bx = b.x - px, by = b.y - py, cx = c.x - px, cy = c.y - py;
    float ea = __fsub_rn(__fmul_rn(bx, cy), __fmul_rn(by, cx));
    float eb = __fsub_rn(__fmul_rn(cx, ay), __fmul_rn(cy, ax));
    float ec = __fsub_rn(__fmul_rn(ax, by), __fmul_rn(ay, bx));
    bool inside = (fminf(fminf(ea, eb), ec) >= 0.f) | (fmaxf(fmaxf(ea, eb), ec) <= 0.f);
    float sum = ea + eb + ec;
    if (inside && sum != 0.f) blend(buffers, x, y, __fdividef(sum, ea * a.z + eb * b.z + ec * c.z), word);
}

// A cluster by one warp.
__device__ __forceinline__ void draw_cluster(
    const Buffers& buffers, const Tile& t, const float* placement, const float* vertices, int vertex_count,
    const u32* triangles, int triangle_count, Scratch& scratch, u32 first_word, int lane
) {
    __syncwarp();
    {
        float m[12];
        load_placement(placement, m);
        for (int i = lane; i < vertex_count; i += 32) {
            float vx = vertices[3 * i], vy = vertices[3 * i + 1], vz = vertices[3 * i + 2];
            float x = m[0] * vx + m[1] * vy + m[2] * vz + m[3];
            float y = m[4] * vx + m[5] * vy + m[6] * vz + m[7];
            float z = m[8] * vx + m[9] * vy + m[10] * vz + m[11];
            float inverse = fast_inverse(z);
            // pixel centres become whole numbers
            scratch.corners[i] = make_float4(x * inverse + (t.cx - 0.5f), y * inverse + (t.cy - 0.5f),
                                             z >= NEAR_M ? inverse : z > 0.f ? TOO_NEAR : BEHIND, 0.f);
        }
    }
    __syncwarp();
    int pairs[2];
    bool exact[2];
#pragma unroll
    for (int r = 0; r < 2; r++) {
        int i = r * 32 + lane;
        pairs[r] = 0;
        exact[r] = false;
        if (i < triangle_count) {
            u32 triangle = triangles[i];
            int4 b = set_up(scratch.corners, triangle, t, exact[r]);
            scratch.triangles[i] = make_uint2(triangle, b.x | b.y << 8 | b.z << 16 | b.w << 24);
            if (!exact[r]) pairs[r] = b.z * b.w;
        }
    }
    __syncwarp();
    int own = pairs[0] + pairs[1];
    if (__any_sync(FULL, own)) {
        int upto = own;
#pragma unroll
        for (int step = 1; step < 32; step <<= 1) {
            int before = __shfl_up_sync(FULL, upto, step);
            if (lane >= step) upto += before;
        }
        int total = __shfl_sync(FULL, upto, 31), first = upto - pairs[1];  // the second triangle's pairs begin there
        for (int start = 0; start < total; start += 32) {
            int pair = start + lane, owner = 0;
#pragma unroll
            for (int step = 16; step; step >>= 1)  // the first lane whose pairs go beyond this one
                if (__shfl_sync(FULL, upto, owner + step - 1) <= pair) owner += step;
            owner = min(owner, 31);
            int k = pair - __shfl_sync(FULL, first, owner), before = __shfl_sync(FULL, pairs[0], owner);
            if (pair < total) {
                int number = owner + 32;
                if (k < 0) {
                    k += before;
                    number = owner;
                }
                uint2 chosen = scratch.triangles[number];
                int width = (chosen.y >> 16) & 255, y = row_of(k, fast_inverse((float)width)), x = k - y * width;
                draw_pixel(buffers, scratch.corners, chosen.x, x + (chosen.y & 255), y + ((chosen.y >> 8) & 255),
                           first_word + number);
            }
        }
    }
    for (int r = 0; r < 2; r++)
        if (__any_sync(FULL, exact[r]))
            draw_exactly(buffers, t.cx, t.cy, placement, vertices, scratch.triangles, exact[r], r * 32 + lane, first_word,
                         lane);
}

// Take the bound of the coarse blocks under a rectangle anew.
__device__ __forceinline__ void refresh(const Buffers& b, const Tile& t, const Rect& r, int lane) {
    __syncwarp();
    int x0 = (int)(r.x0 * 0.125f), x1 = min((t.width - 1) >> 3, (int)(r.x1 * 0.125f));
    int y0 = (int)(r.y0 * 0.125f), y1 = min((t.height - 1) >> 3, (int)(r.y1 * 0.125f));
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
    int tile_x = tile % across * TILE, tile_y = tile / across * TILE;
    Tile t = {camera[14] * s.scale - tile_x, camera[15] * s.scale - tile_y, min(TILE, s.width - tile_x),
              min(TILE, s.height - tile_y)};

    Buffers buffers = {shared, (float*)(shared + TILE * TILE), fmaxf(camera[16], SMALLEST_M)};
    Scratch* scratches = (Scratch*)(buffers.coarse + COARSE_WORDS);
    Scratch& scratch = scratches[warp];
    u32* list = (u32*)(scratches + WARPS);  // bucket << 16 | item
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
        Rect own = {0, 0, 0, 0, 0}, covered = {0, TILE, TILE, 0, 0};
        if (lane < clusters) {
            center = boxes[first + lane].center;
            half = boxes[first + lane].half;
            waiting = visible(m, center, half, t, own) && !hidden_coarsely(buffers, t, own);
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
            draw_cluster(buffers, t, placement + 12 * place.slot, vertices + 3 * (size_t)vertex, counts & 0xffff,
                         s.triangles + (size_t)(first + chosen) * CLUSTER_TRIANGLES, counts >> 16, scratch,
                         (u32)item << 11 | chosen << 6, lane);
        }
        if (drawn) refresh(buffers, t, covered, lane);
    }
    __syncthreads();
    for (int i = tid; i < TILE * TILE; i += THREADS) {
        int x = i % TILE, y = i / TILE;
        if (x >= t.width || y >= t.height) continue;
        size_t at = ((size_t)local * s.height + tile_y + y) * s.width + tile_x + x;
        u32 word = (u32)buffers.pixels[i];
        f.depth[at] = word == NOTHING ? 0.f : __uint_as_float((u32)(buffers.pixels[i] >> 32));
        f.words[at] = word;
    }
}
