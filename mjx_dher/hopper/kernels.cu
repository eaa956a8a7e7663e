// CUDA of `fused`: a learner's passes through its networks, whose activations stay in registers. For Hopper GPUs.
//
// A block takes 128 rows of a lane's batch through all its passes, in two warpgroups of 64 rows each. The product of 64 rows
// with a layer's weights is 16 times a `wgmma` of 64 x 256 x 16; its result lies in registers just as the next product wants
// its left factor, so that activations never leave them, but for those that the weights' gradients need. Weights come as one
// stream of chunks of 64 rows, each copied into a ring in shared memory by the copy engine while the chunks before it are
// multiplied; the two blocks of a cluster, which need the same ones, share the copying. The warpgroups multiply by turns, so
// that one multiplies while the other does all the rest.
//
// These are bodies of functions: `fused_kernels.py` puts "streams", a kernel's "... source", "common" and the kernel's rest
// together, and gives the names in capitals.

//// streams

    const int lane = blockIdx.x / tiles;
    auto of = [&](const wp::array_t<wp::bfloat16>& weights, int chunks, int chunk) {
        return weights.data + (static_cast<size_t>(lane) * chunks + chunk) * CHUNK;
    };
    auto part = [&](int chunk, const wp::array_t<wp::bfloat16>& first, const wp::array_t<wp::bfloat16>& second,
                    const wp::array_t<wp::bfloat16>& third) {
        return chunk < 1 ? of(first, 1, 0) : chunk < 5 ? of(second, 4, chunk - 1) : of(third, 4, chunk - 5);
    };

//// critic source

    auto source = [&](int chunk) {
        if (chunk < 9) return part(chunk, target_actor_1, target_actor_2, target_actor_3);
        if (chunk < 18) return part(chunk - 9, target_critic_1, target_critic_2, target_critic_3);
        if (chunk < 27) return part(chunk - 18, critic_1, critic_2, critic_3);
        return chunk < 31 ? of(critic_3t, 4, chunk - 27) : of(critic_2t, 4, chunk - 31);
    };
    constexpr int TOTAL = 35, VECTORS = ACTOR_VECTORS + 2 * CRITIC_VECTORS, MASKS = 3;

//// actor source

    auto source = [&](int chunk) {
        if (chunk < 9) return part(chunk, actor_1, actor_2, actor_3);
        if (chunk < 18) return part(chunk - 9, critic_1, critic_2, critic_3);
        if (chunk < 22) return of(critic_3t, 4, chunk - 18);
        if (chunk < 26) return of(critic_2t, 4, chunk - 22);
        return chunk < 30 ? of(actor_3t, 4, chunk - 26) : of(actor_2t, 4, chunk - 30);
    };
    constexpr int TOTAL = 34, VECTORS = ACTOR_VECTORS + CRITIC_VECTORS + 4 * WIDTH, MASKS = 6;

//// common

    // `acc` is the result of a product and `a` the left factor of the next one, two bfloat16 a register. Four threads share a
    // row: thread t has acc[4 j] and the next of j = 4 q + i, and of the row eight below the two after them, as columns
    // 32 q + 8 t + 2 i and the next. The product itself would number them 8 j + 2 t; weights come in an order that makes up for
    // it (`fused.blocks`).
    extern __shared__ char dynamic_smem_base[];
    char* const ring = dynamic_smem_base;
    float* const vectors = reinterpret_cast<float*>(ring + STAGES * CHUNK * 2);
    uint4* const masks = reinterpret_cast<uint4*>(vectors + VECTORS);
    unsigned long long* const full = reinterpret_cast<unsigned long long*>(masks + MASKS * CONSUMERS);
    unsigned long long* const empty = full + STAGES;
    const int tid = threadIdx.x;
    const int t = tid & 3;
    const int batch = tiles * ROWS;
    const int tile = blockIdx.x % tiles;
    const int row = tile * ROWS + (tid / 32) * 16 + (tid & 31) / 4;  // and row + 8
    using Pair = float[2];
    using Four = float[4];
    using Fours = float[2][4];
    float acc[128];
    unsigned a[64];

    auto address = [](const void* p) { return static_cast<unsigned>(__cvta_generic_to_shared(p)); };
    auto wait = [&](const void* barrier, unsigned parity) {
        asm volatile(
            "{\n.reg .pred done;\nagain:\n"
            "mbarrier.try_wait.parity.shared::cta.b64 done, [%0], %1;\n"
            "@done bra over;\nbra again;\nover:\n}\n" ::"r"(address(barrier)), "r"(parity) : "memory");
    };
    unsigned rank;  // of the cluster's blocks, which take the same chunks at about the same time
    asm volatile("mov.u32 %0, %%cluster_ctarank;" : "=r"(rank));
    auto meet = [&]() {
        asm volatile("barrier.cluster.arrive.release.aligned;\nbarrier.cluster.wait.acquire.aligned;" ::: "memory");
    };
    // What the third warpgroup does: one thread copies its share of chunk after chunk to all of the cluster's blocks, as soon
    // as the rings have room.
    auto feed = [&]() {
        asm volatile("setmaxnreg.dec.sync.aligned.u32 24;");
        if (tid == CONSUMERS) {
            constexpr int share = CHUNK * 2 / BLOCKS;
#pragma unroll 1
            for (int chunk = 0; chunk < TOTAL; ++chunk) {
                const int slot = chunk % STAGES;
                if (chunk >= STAGES) wait(empty + slot, (chunk / STAGES - 1) & 1);
                asm volatile(
                    "mbarrier.arrive.expect_tx.shared::cta.b64 _, [%0], %1;" ::"r"(address(full + slot)), "n"(CHUNK * 2)
                    : "memory");
                asm volatile(
                    "cp.async.bulk.shared::cluster.global.mbarrier::complete_tx::bytes.multicast::cluster "
                    "[%0], [%1], %2, [%3], %4;" ::"r"(address(ring + slot * CHUNK * 2) + rank * share),
                    "l"(reinterpret_cast<const char*>(source(chunk)) + rank * share), "n"(share), "r"(address(full + slot)),
                    "h"(static_cast<unsigned short>((1 << BLOCKS) - 1))
                    : "memory");
            }
        }
        __syncwarp();
        meet();
    };
    using Vector = wp::array_t<wp::float32>;
    // What a thread brings of a network: of its unit the biases and the last layer's weights, and of the last biases one.
    struct Unit {
        float b1, b2, b3, w4[4], b4;
    };
    auto fetch = [&](const Vector& b1, const Vector& b2, const Vector& b3, const Vector& w4, const Vector& b4, int columns) {
        const int unit = lane * WIDTH + tid;
        Unit result = {b1.data[unit], b2.data[unit], b3.data[unit], {0.0f, 0.0f, 0.0f, 0.0f}, 0.0f};
#pragma unroll
        for (int i = 0; i < 4; ++i) {
            if (i < columns) result.w4[i] = w4.data[unit * columns + i];
        }
        if (tid < columns) result.b4 = b4.data[lane * columns + tid];
        return result;
    };
    auto put = [&](float* to, const Unit& unit, bool is_actor) {
        to[tid] = unit.b1;
        to[WIDTH + tid] = unit.b2;
        to[2 * WIDTH + tid] = unit.b3;
        if (is_actor) {
#pragma unroll
            for (int i = 0; i < 4; ++i) to[(3 + i) * WIDTH + tid] = unit.w4[i];
            if (tid < 4) to[7 * WIDTH + tid] = unit.b4;
        } else {
            to[3 * WIDTH + tid] = unit.w4[0];
            if (tid == 0) to[4 * WIDTH] = unit.b4;
        }
    };
    if (tid == 0) {
        for (int i = 0; i < STAGES; ++i) {
            asm volatile(
                "mbarrier.init.shared::cta.b64 [%0], 1;\nmbarrier.init.shared::cta.b64 [%1], %2;" ::"r"(address(full + i)),
                "r"(address(empty + i)), "n"(BLOCKS * CONSUMERS / 32)
                : "memory");
        }
        asm volatile("fence.mbarrier_init.release.cluster;" ::: "memory");
        asm volatile("fence.proxy.async.shared::cta;" ::: "memory");
    }
    __syncthreads();
    meet();
    if (tid >= CONSUMERS) {
        feed();
        return;
    }
    asm volatile("setmaxnreg.inc.sync.aligned.u32 240;");
    auto gather = [&]() { asm volatile("bar.sync 1, %0;" ::"n"(CONSUMERS) : "memory"); };
    const int group = tid / 128;
    // The two warpgroups multiply by turns, so that one multiplies while the other does all the rest.
    auto await_turn = [&]() { asm volatile("bar.sync %0, %1;" ::"r"(2 + group), "n"(CONSUMERS) : "memory"); };
    auto pass_turn = [&]() { asm volatile("bar.arrive %0, %1;" ::"r"(3 - group), "n"(CONSUMERS) : "memory"); };
    if (group == 1) pass_turn();
    int slot = 0;
    unsigned parity = 0;
    auto release = [&](int which) {
        // Lane i of a warp tells the cluster's block i.
        asm volatile(
            "{\n.reg .pred one;\n.reg .b32 there;\nsetp.lt.u32 one, %1, %2;\n@one mapa.shared::cluster.u32 there, %0, %1;\n"
            "@one mbarrier.arrive.relaxed.cluster.shared::cluster.b64 _, [there];\n}\n" ::"r"(address(empty + which)),
            "r"(tid & 31), "n"(BLOCKS)
            : "memory");
    };
    // acc = (first ? 0 : acc) + four groups of `a`'s registers, from `from` on, times the next chunk.
    auto multiply_chunk = [&](int from, bool first) {
        wait(full + slot, parity);
        // Of the ring's matrices of 8 x 8 numbers, 128 bytes each, neighbours in k are 4,096 bytes apart.
        const unsigned long long start = (address(ring + slot * CHUNK * 2) & 0x3FFFF) >> 4;
        const unsigned long long matrix = start | (256ull << 16) | (8ull << 32);
#pragma unroll
        for (int k = 0; k < 4; ++k) {
            const int i = from + 4 * k;
            asm volatile(
                "{\n.reg .pred p;\nsetp.ne.b32 p, %133, 0;\n"
                "wgmma.mma_async.sync.aligned.m64n256k16.f32.bf16.bf16 {ACCUMULATORS}, "
                "{%128, %129, %130, %131}, %132, p, 1, 1, 0;\n}\n"
                : OPERANDS
                : "r"(a[i]), "r"(a[i + 1]), "r"(a[i + 2]), "r"(a[i + 3]), "l"(matrix + k * 512), "r"(first && k == 0 ? 0 : 1));
        }
        asm volatile("wgmma.commit_group.sync.aligned;" ::: "memory");
        if (++slot == STAGES) { slot = 0; parity ^= 1; }
    };
    auto previous = [&]() { return slot == 0 ? STAGES - 1 : slot - 1; };
    auto before_previous = [&]() { return slot >= 2 ? slot - 2 : slot + STAGES - 2; };
    // acc = the first 16 registers of `a` times the next chunk.
    auto multiply_inputs = [&]() {
        asm volatile("wgmma.fence.sync.aligned;" ::: "memory");
        multiply_chunk(0, true);
        asm volatile("wgmma.wait_group.sync.aligned 0;" ::: "memory");
        release(previous());
    };
    // acc = a times the next four chunks.
    auto multiply = [&]() {
        await_turn();
        asm volatile("wgmma.fence.sync.aligned;" ::: "memory");
        multiply_chunk(0, true);
#pragma unroll
        for (int chunk = 1; chunk < 4; ++chunk) {
            multiply_chunk(16 * chunk, false);
            if (chunk == 3) pass_turn();
            asm volatile("wgmma.wait_group.sync.aligned 1;" ::: "memory");
            release(before_previous());
        }
        asm volatile("wgmma.wait_group.sync.aligned 0;" ::: "memory");
        release(previous());
    };
    auto finish = [&]() {
        if (group == 0) await_turn();  // of which there is one more than products
        meet();  // no block goes while another may write to it
    };
    auto column = [&](int j) { return 32 * (j / 4) + 8 * t + 2 * (j % 4); };
    auto pack = [](float low, float high) {
        unsigned both;
        asm("cvt.rn.bf16x2.f32 %0, %1, %2;" : "=r"(both) : "f"(high), "f"(low));
        return both;
    };
    auto low = [](unsigned both) { return __uint_as_float(both << 16); };
    auto high = [](unsigned both) { return __uint_as_float(both & 0xFFFF0000u); };
    // a = acc, of which neighbouring columns share a register.
    auto keep = [&]() {
#pragma unroll
        for (int i = 0; i < 64; ++i) a[i] = pack(acc[2 * i], acc[2 * i + 1]);
    };
    auto round_off = [&]() {
#pragma unroll
        for (int i = 0; i < 64; ++i) { acc[2 * i] = low(a[i]); acc[2 * i + 1] = high(a[i]); }
    };
    // a = max(0, acc + bias). Bits of `mask`, where it is not null, say where that is not 0: of a[16 n + k]'s two, bits k and
    // 16 + k of word n.
    auto activate = [&](const float* bias, uint4* mask) {
#pragma unroll
        for (int j = 0; j < 32; ++j) {
            const float2 b = *reinterpret_cast<const float2*>(bias + column(j));
#pragma unroll
            for (int i = 0; i < 2; ++i) {
                asm("cvt.rn.relu.bf16x2.f32 %0, %1, %2;"
                    : "=r"(a[2 * j + i])
                    : "f"(acc[4 * j + 2 * i + 1] + b.y), "f"(acc[4 * j + 2 * i] + b.x));
            }
        }
        if (mask != nullptr) {
            unsigned bits[4] = {0, 0, 0, 0};
#pragma unroll
            for (int i = 0; i < 64; ++i) bits[i / 16] = (bits[i / 16] >> 1) | ((a[i] + 0x7FFF7FFFu) & 0x80008000u);
            mask[tid] = make_uint4(bits[0], bits[1], bits[2], bits[3]);
        }
    };
    auto silence = [&](const uint4* mask) {
        const uint4 m = mask[tid];
        const unsigned bits[4] = {m.x, m.y, m.z, m.w};
#pragma unroll
        for (int i = 0; i < 128; ++i) {
            if (!(bits[i / 32] & (1u << (i / 2 % 16 + 16 * (i % 2))))) acc[i] = 0.0f;
        }
    };
    // Writes `a` as rows of [B, 256].
    auto store = [&](wp::bfloat16* to) {
#pragma unroll
        for (int half = 0; half < 2; ++half) {
            uint4* const line = reinterpret_cast<uint4*>(to + (static_cast<size_t>(lane) * batch + row + 8 * half) * WIDTH) + t;
#pragma unroll
            for (int q = 0; q < 8; ++q)
                line[4 * q] = make_uint4(a[8 * q + half], a[8 * q + 2 + half], a[8 * q + 4 + half], a[8 * q + 6 + half]);
        }
    };
    // Writes the columns' sums of acc over this warp's 16 rows; acc is lost.
    auto sum = [&](float* to) {
#pragma unroll
        for (int j = 0; j < 32; ++j) {
#pragma unroll
            for (int b = 0; b < 2; ++b) acc[2 * j + b] = acc[4 * j + b] + acc[4 * j + 2 + b];
        }
        const int bits = (tid & 31) / 4;
        auto halve = [&](bool upper, int distance, int left) {
#pragma unroll
            for (int i = 0; i < 32; ++i) {
                if (i < left) {
                    const float given = upper ? acc[i] : acc[i + left];
                    const float kept = upper ? acc[i + left] : acc[i];
                    acc[i] = kept + __shfl_xor_sync(0xFFFFFFFFu, given, distance);
                }
            }
        };
        halve(bits & 4, 16, 32);
        halve(bits & 2, 8, 16);
        halve(bits & 1, 4, 8);
        // This thread is left with the columns of the q that is its place among the eight rows.
        float4* const line = reinterpret_cast<float4*>(
            to + ((static_cast<size_t>(lane) * tiles + tile) * (CONSUMERS / 32) + tid / 32) * WIDTH + 32 * bits + 8 * t);
        line[0] = make_float4(acc[0], acc[1], acc[2], acc[3]);
        line[1] = make_float4(acc[4], acc[5], acc[6], acc[7]);
    };
    // Of both rows, the product with a column of weights, in all four threads of a row.
    auto dot = [&](const float* weights, float bias, Pair& result) {
        float sums[2] = {0.0f, 0.0f};
#pragma unroll
        for (int j = 0; j < 32; ++j) {
            const float2 w = *reinterpret_cast<const float2*>(weights + column(j));
#pragma unroll
            for (int i = 0; i < 4; ++i) sums[i / 2] += acc[4 * j + i] * (i & 1 ? w.y : w.x);
        }
#pragma unroll
        for (int i = 0; i < 2; ++i) {
            sums[i] += __shfl_xor_sync(0xFFFFFFFFu, sums[i], 1);
            sums[i] += __shfl_xor_sync(0xFFFFFFFFu, sums[i], 2);
            result[i] = sums[i] + bias;
        }
    };
    // The same with four columns, weights [4, 256].
    auto dot4 = [&](const float* weights, Fours& result) {
        float sums[2][4] = {};
#pragma unroll
        for (int j = 0; j < 32; ++j) {
#pragma unroll
            for (int k = 0; k < 4; ++k) {
                const float2 w = *reinterpret_cast<const float2*>(weights + k * WIDTH + column(j));
#pragma unroll
                for (int i = 0; i < 2; ++i) sums[i][k] += acc[4 * j + 2 * i] * w.x + acc[4 * j + 2 * i + 1] * w.y;
            }
        }
#pragma unroll
        for (int i = 0; i < 8; ++i) {
            float& s = sums[i / 4][i % 4];
            s += __shfl_xor_sync(0xFFFFFFFFu, s, 1);
            s += __shfl_xor_sync(0xFFFFFFFFu, s, 2);
            result[i / 4][i % 4] = s;
        }
    };
    auto policy = [&](const float* weights, const float* bias, Fours& action) {
        dot4(weights, action);
#pragma unroll
        for (int i = 0; i < 8; ++i) action[i / 4][i % 4] = tanhf(action[i / 4][i % 4] + bias[i % 4]);
    };
    // The first 16 registers of `a`: both rows of inputs [B, 64].
    auto read = [&](const wp::bfloat16* from) {
        const wp::bfloat16* const start = from + (static_cast<size_t>(lane) * batch + row) * INPUTS;
        const unsigned* const line = reinterpret_cast<const unsigned*>(start) + t;
#pragma unroll
        for (int k = 0; k < 4; ++k) {
            a[4 * k] = line[8 * k];
            a[4 * k + 1] = line[8 * k + 8 * INPUTS / 2];
            a[4 * k + 2] = line[8 * k + 4];
            a[4 * k + 3] = line[8 * k + 4 + 8 * INPUTS / 2];
        }
    };
    auto set_action = [&](Fours& action) {
#pragma unroll
        for (int i = 0; i < 2; ++i) {
            const unsigned first = pack(action[i][0], action[i][1]), second = pack(action[i][2], action[i][3]);
            a[14 + i] = t == 0 ? first : t == 1 ? second : 0u;
        }
    };

//// critic

    float* const target_actor_v = vectors;
    float* const target_critic_v = target_actor_v + ACTOR_VECTORS;
    float* const critic_v = target_critic_v + CRITIC_VECTORS;
    read(next_x.data);
    const size_t first = static_cast<size_t>(lane) * batch + row;
    const float discount = gamma.data[lane];
    const float rewards[2] = {reward.data[first], reward.data[first + 8]};
    {
        const Unit one = fetch(target_actor_b1, target_actor_b2, target_actor_b3, target_actor_w4, target_actor_b4, size);
        const Unit two = fetch(target_critic_b1, target_critic_b2, target_critic_b3, target_critic_w4, target_critic_b4, 1);
        const Unit three = fetch(critic_b1, critic_b2, critic_b3, critic_w4, critic_b4, 1);
        put(target_actor_v, one, true);
        put(target_critic_v, two, false);
        put(critic_v, three, false);
        gather();
    }
    float action[2][4] = {};
    float target[2] = {0.0f, 0.0f}, q[2], dq[2];
#pragma unroll 1
    for (int net = 0; net < 3; ++net) {
        const float* const net_v = net == 0 ? target_actor_v : net == 1 ? target_critic_v : critic_v;
        if (net == 1) set_action(action);
#pragma unroll 1
        for (int layer = 0; layer < 3; ++layer) {
            if (layer == 0) multiply_inputs();
            else multiply();
            activate(net_v + layer * WIDTH, net == 2 ? masks + layer * CONSUMERS : nullptr);
            if (net == 2 && layer < 2) store(layer == 0 ? h1.data : h2.data);
        }
        round_off();
        if (net < 2) read(net == 0 ? next_x.data : x.data);  // of the next network
        if (net == 0) {
            policy(net_v + 3 * WIDTH, net_v + 7 * WIDTH, action);
        } else {
            dot(net_v + 3 * WIDTH, net_v[4 * WIDTH], q);
        }
        if (net == 1) {
            for (int i = 0; i < 2; ++i) {
                target[i] = fminf(fmaxf(rewards[i] + discount * q[i], -1.0f / (1.0f - discount)), 0.0f);
            }
        }
    }
    for (int i = 0; i < 2; ++i) {
        dq[i] = 2.0f / batch * (q[i] - target[i]);
        if (t == 0) {
            q_out.data[first + 8 * i] = q[i];
            target_out.data[first + 8 * i] = target[i];
        }
    }
#pragma unroll
    for (int i = 0; i < 128; ++i) acc[i] *= dq[i / 2 % 2];
    sum(sum4.data);
#pragma unroll
    for (int j = 0; j < 32; ++j) {
        const float2 w = *reinterpret_cast<const float2*>(critic_v + 3 * WIDTH + column(j));
#pragma unroll
        for (int i = 0; i < 4; ++i) acc[4 * j + i] = dq[i / 2] * (i & 1 ? w.y : w.x);
    }
#pragma unroll 1
    for (int layer = 2; layer >= 0; --layer) {
        if (layer < 2) multiply();
        silence(masks + layer * CONSUMERS);
        keep();
        store(layer == 0 ? d1.data : layer == 1 ? d2.data : d3.data);
        sum(layer == 0 ? sum1.data : layer == 1 ? sum2.data : sum3.data);
    }
    finish();

//// actor

    float* const actor_v = vectors;
    float* const critic_v = actor_v + ACTOR_VECTORS;
    float* const critic_action_v = critic_v + CRITIC_VECTORS;  // the first layer's rows of the action, [4, 256]
    read(x.data);
    {
        const Unit one = fetch(actor_b1, actor_b2, actor_b3, actor_w4, actor_b4, size);
        const Unit two = fetch(critic_b1, critic_b2, critic_b3, critic_w4, critic_b4, 1);
        float rows[4];
#pragma unroll
        for (int i = 0; i < 4; ++i)
            rows[i] = i < size ? critic_action.data[(static_cast<size_t>(lane) * size + i) * WIDTH + tid] : 0.0f;
        put(actor_v, one, true);
        put(critic_v, two, false);
#pragma unroll
        for (int i = 0; i < 4; ++i) critic_action_v[i * WIDTH + tid] = rows[i];
        gather();
    }
    float action[2][4], slope[2][4], q[2];
    const size_t first = static_cast<size_t>(lane) * batch + row;
#pragma unroll 1
    for (int net = 0; net < 2; ++net) {
        const float* const net_v = net == 0 ? actor_v : critic_v;
        if (net == 1) set_action(action);
#pragma unroll 1
        for (int layer = 0; layer < 3; ++layer) {
            if (layer == 0) multiply_inputs();
            else multiply();
            activate(net_v + layer * WIDTH, masks + (3 * net + layer) * CONSUMERS);
            if (net == 0) store(layer == 0 ? h1.data : layer == 1 ? h2.data : h3.data);
        }
        round_off();
        if (net == 0) {
            read(x.data);
            policy(net_v + 3 * WIDTH, net_v + 7 * WIDTH, action);
        } else {
            dot(net_v + 3 * WIDTH, net_v[4 * WIDTH], q);
        }
    }
#pragma unroll 1
    for (int net = 1; net >= 0; --net) {
        if (net == 1) {
#pragma unroll
            for (int j = 0; j < 32; ++j) {
                const float2 w = *reinterpret_cast<const float2*>(critic_v + 3 * WIDTH + column(j));
#pragma unroll
                for (int i = 0; i < 4; ++i) acc[4 * j + i] = -1.0f / batch * (i & 1 ? w.y : w.x);
            }
        } else {
#pragma unroll
            for (int j = 0; j < 32; ++j) {
#pragma unroll
                for (int i = 0; i < 4; ++i) acc[4 * j + i] = 0.0f;
#pragma unroll
                for (int k = 0; k < 4; ++k) {
                    const float2 w = *reinterpret_cast<const float2*>(actor_v + (3 + k) * WIDTH + column(j));
#pragma unroll
                    for (int i = 0; i < 4; ++i) acc[4 * j + i] += slope[i / 2][k] * (i & 1 ? w.y : w.x);
                }
            }
        }
#pragma unroll 1
        for (int layer = 2; layer >= 0; --layer) {
            if (layer < 2) multiply();
            silence(masks + (3 * net + layer) * CONSUMERS);
            keep();
            if (net == 0) {
                store(layer == 0 ? d1.data : layer == 1 ? d2.data : d3.data);
                sum(layer == 0 ? sum1.data : layer == 1 ? sum2.data : sum3.data);
            }
        }
        if (net == 1) {
            round_off();
            dot4(critic_action_v, slope);
            const float penalty = 2.0f * action_l2.data[lane] / (static_cast<float>(batch) * size);
            for (int i = 0; i < 2; ++i) {
                Four& u = action[i];
                Four& du = slope[i];
                for (int k = 0; k < 4; ++k) du[k] = (du[k] + penalty * u[k]) * (1.0f - u[k] * u[k]);
                if (t == 0) {
                    q_out.data[first + 8 * i] = q[i];
                    reinterpret_cast<float4*>(action_out.data)[first + 8 * i] = make_float4(u[0], u[1], u[2], u[3]);
                    reinterpret_cast<float4*>(slope_out.data)[first + 8 * i] = make_float4(du[0], du[1], du[2], du[3]);
                }
            }
        }
    }
    finish();
