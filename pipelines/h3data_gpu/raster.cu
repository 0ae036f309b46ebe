// The rasteriser: one block per pixel tile and world.
//
// 1. Items (up to 32 clusters each) against the tile's frustum; a counting sort puts the survivors front to back.
// 2. Warps pull items. A cluster is skipped if everything in its rectangle is nearer (hierarchical z).
// 3. A warp projects a cluster's vertices into shared memory, one lane each; then every lane sets up two triangles.
// 4. Small triangles: the (triangle, pixel) pairs of all 64 are dealt out evenly to the lanes.
//    Large, thin, or near ones: homogeneous edge functions in double, the warp's lanes over the pixels. No near plane.
//    So are all that are cut out: their pixels look at the texture's opacity before anything is written.
// 5. A 64-bit atomic minimum of (depth bits, word) keeps the nearest; ties go to the smaller word, so pictures repeat.

struct Raster {
    World world;
    float* depth;                // [views, height, width]; 0 = nothing
    u32* words;
    const Cutouts* cutouts;      // in memory: only what is cut out looks at it
};

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
            CutOut holes = {HOLES && counts < 0 ? f.cutouts : nullptr, (first + chosen) * CLUSTER_TRIANGLES, vertex};
            draw_cluster(buffers, t, placement + 12 * place.slot, vertices + 3 * (size_t)vertex, counts & 0xffff,
                         s.triangles + (size_t)(first + chosen) * CLUSTER_TRIANGLES, (counts >> 16) & 0x7fff, scratch,
                         (u32)item << 11 | chosen << 6, lane, holes);
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
