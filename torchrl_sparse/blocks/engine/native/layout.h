// The memory that Python and C++ share, described once: structs.h declares it in C++ and layout.py in Python, and
// library.py refuses a compiled library whose hash of it is another.
//
// No guard: it is included wherever the macros mean something else. One macro is one line, a comment may follow it.

CONSTANT(INTERFACE, 2)     // counted up whenever the arguments of a function of native.cpp change
CONSTANT(CACHE_LINE, 64)   // bytes
CONSTANT(PANEL, 32)        // columns of a matrix that lie side by side; rows are padded to them
CONSTANT(PART, 256)        // inputs of a matrix that are multiplied one after the other
CONSTANT(HEAD, 16)         // heads are padded to multiples of it, which are whole vectors
CONSTANT(COEFFICIENTS, 8)  // of a denoising step, see coefficients.py
CONSTANT(MAX_HIDDEN, 256)  // of a pruner, which keeps a dozen cells on the stack
CONSTANT(MAX_OBS_STEPS, 63)
CONSTANT(MAX_THREADS, 64)  // of a team

// Types of weights.
CONSTANT(F32, 0)
CONSTANT(F16, 1)
CONSTANT(BF16, 2)
CONSTANT(I8, 3)

// A packed matrix [part][columns / 32][inputs of the part][32]. Of BF16, two inputs count as one, and of I8 four: they lie
// side by side.
STRUCT(Matrix)
FIELD(const void*, weight)
FIELD(const float*, bias)    // [columns], or one row of it for each row of the result
FIELD(const float*, scale)   // of I8 [columns]: what a weight of 1 stands for
FIELD(const int32_t*, sums)  // of I8 [columns]: of the weights
FIELD(int32_t, rows)
FIELD(int32_t, columns)
FIELD(int32_t, bias_stride)
FIELD(int32_t, type)
END

STRUCT(Layer)
FIELD(Matrix, qkv)  // LayerNorm's gain and shift and 1/sqrt(head size) are folded in
FIELD(Matrix, out)
FIELD(Matrix, up)
FIELD(Matrix, down)
FIELD(Matrix, kv)                 // cross-attention: memory token -> its keys and values
FIELD(const Matrix*, fold)        // [2][heads]: key -> what it weighs normalised activations with, value -> what it adds
FIELD(const float*, query_bias)   // [heads * padded head size]
FIELD(const float*, cross_bias)   // [padded width]
END

STRUCT(Model)
FIELD(int32_t, horizon)
FIELD(int32_t, width)
FIELD(int32_t, layers)
FIELD(int32_t, heads)
FIELD(int32_t, obs_steps)
FIELD(int32_t, action_dim)
FIELD(int32_t, cond_dim)
FIELD(int32_t, steps)
FIELD(int32_t, causal)
FIELD(int32_t, history)           // 0 unless the sampler reads earlier clean predictions
FIELD(float, clip)
FIELD(const Layer*, layer)
FIELD(Matrix, embed)              // embed and encode_up have a bias for each row: it holds the positions
FIELD(Matrix, head)
FIELD(Matrix, encode_up)
FIELD(Matrix, encode_down)
FIELD(const float*, time_key)     // [steps][layers][heads][padded width], the folded keys of the time tokens
FIELD(const float*, time_value)   // likewise
FIELD(const float*, time_bias)    // [steps][layers][heads]
FIELD(const float*, coefficients) // [steps][COEFFICIENTS]
FIELD(const float*, valid)        // [padded width]: 1 for each column, 0 for the padding
END

// The MLP of a pruner, see pruner.py. A cell is a block of a denoising step.
STRUCT(Pruner)
FIELD(Matrix, obs)          // observation -> what it adds to every cell
FIELD(Matrix, middle)       // cell -> its second hidden layer
FIELD(const float*, cells)  // [count][padded width]: what a cell is without an observation
FIELD(const float*, last)   // [padded width]
FIELD(float, bias)          // of the last layer
FIELD(int32_t, count)       // of cells
FIELD(int32_t, first)       // cells of the first step, which is never pruned
END

// Scale and offset of each number of a state and of an action.
STRUCT(Units)
FIELD(const float*, state_scale)
FIELD(const float*, state_offset)
FIELD(const float*, action_scale)
FIELD(const float*, action_offset)
END

// The header of an exported policy, little-endian and padded to whole cache lines. Change it, and count TSP_VERSION up.
CONSTANT(TSP_VERSION, 1)
CONSTANT(TSP_MAGIC, "TSPOLICY")
CONSTANT(TSP_CHECKED_FROM, 16)  // what the checksum covers, up to the end
CONSTANT(DENSE, 0)
CONSTANT(MASK, 1)
CONSTANT(PRUNER, 2)

STRUCT(Header)
FIELD(Magic, magic)
FIELD(uint32_t, version)
FIELD(uint32_t, checksum)    // CRC-32
FIELD(uint64_t, size)        // of the file
FIELD(int32_t, horizon)
FIELD(int32_t, width)
FIELD(int32_t, layers)
FIELD(int32_t, heads)
FIELD(int32_t, obs_steps)
FIELD(int32_t, action_dim)
FIELD(int32_t, cond_dim)
FIELD(int32_t, steps)
FIELD(int32_t, causal)
FIELD(int32_t, history)
FIELD(int32_t, weights)      // type of the large matrices
FIELD(int32_t, slots)        // see Buffers::latest
FIELD(int32_t, plan)         // DENSE, MASK or PRUNER
FIELD(int32_t, hidden)       // of a pruner
FIELD(int32_t, rated)        // of a pruner: whether the rate is an input
FIELD(int32_t, pruned)       // if it is, the cells to prune
FIELD(int32_t, description)  // bytes
FIELD(float, clip)
FIELD(float, bias)           // of a pruner
FIELD(float, rate)           // of a pruner
END

#undef CONSTANT
#undef STRUCT
#undef FIELD
#undef END
