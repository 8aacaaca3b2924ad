// The passes of networks and Adam's step as functions that XLA calls. Arrays have a leading [networks], which are fitted
// next to each other; each is computed in the same order whatever the number of networks and of threads.
#include "native.h"
#include "adam.h"
#include "gru.h"
#include "passes.h"

namespace {

constexpr int MOST_WEIGHTS = 4 * MOST_LAYERS + 2;

struct Call {
  Shape shape;
  long networks, activation;
  const float *x, *weights[MOST_WEIGHTS], *gradient;
  float *out, *saved, *scratch, *input_gradient, *gradients[MOST_WEIGHTS];
  long weight_size[MOST_WEIGHTS], saved_size, scratch_size;
};

const float* floats(const XLA_FFI_Buffer* buffer) {
  return buffer->dtype == XLA_FFI_DataType_F32 ? (const float*)buffer->data : nullptr;
}
const XLA_FFI_Buffer* operand(const XLA_FFI_CallFrame* frame, long k) { return (const XLA_FFI_Buffer*)frame->args.args[k]; }
const XLA_FFI_Buffer* result(const XLA_FFI_CallFrame* frame, long k) { return (const XLA_FFI_Buffer*)frame->rets.rets[k]; }

// The layers of network n. Weights lie as a flax module has them: [norm of the input], then kernel, bias and [norm] of
// each layer.
void layers_of(const Call& call, long n, Layer* layers, Norm* norms) {
  const Shape& shape = call.shape;
  long next = 0;
  const auto take = [&] {
    const long k = next++;
    return call.weights[k] + n * call.weight_size[k];
  };
  const auto norm = [&](long layer) {
    if (!shape.normed(layer)) return Norm{};
    const float* scale = take();
    return Norm{scale, take()};
  };
  norms[0] = norm(-1);
  for (long l = 0; l < shape.layers; ++l) {
    layers[l].in = shape.width[l], layers[l].out = shape.width[l + 1];
    layers[l].kernel = take(), layers[l].bias = take();
    norms[l + 1] = norm(l);
  }
}

void pack_task(const Call& call, const Packed& packed, long n, long layer) {
  Layer layers[MOST_LAYERS];
  Norm norms[MOST_LAYERS + 1];
  layers_of(call, n, layers, norms);
  pack_layer(call.shape, layers[layer], norms[layer], packed, layer);
}

void forward_rows(const Call& call, const Shape& shape, const Saved& saved, const float* x, float* out, long first,
                  long rows) {
  if (call.activation == RELU) return forward<RELU>(shape, saved, x, out, first, rows);
  if (call.activation == TANH) return forward<TANH>(shape, saved, x, out, first, rows);
  return forward<ELU>(shape, saved, x, out, first, rows);
}

void forward_task(void* data, int phase, long index) {
  const Call& call = *(const Call*)data;
  const Shape& shape = call.shape;
  const long tasks = phase ? shape.chunks() : shape.layers, n = index / tasks, k = index % tasks;
  Saved saved;
  float* block = call.saved + n * call.saved_size;
  const long weights = saved.Packed::place(shape, block);
  if (phase == 0) return pack_task(call, saved, n, k);
  const long first = k * CHUNK, rows = least(CHUNK, shape.rows - first);
  const float* x = call.x + n * shape.rows * shape.width[0];
  float* out = call.out + n * shape.rows * shape.width[shape.layers];
  if (shape.gradient) {
    saved.place_rows(shape, block + weights);
    return forward_rows(call, shape, saved, x, out, first, rows);
  }
  Shape here = shape;
  here.rows = CHUNK;
  float* own = memory(saved.place_rows(here, nullptr));
  saved.place_rows(here, own);
  x += first * shape.width[0], out += first * shape.width[shape.layers];
  if (own) return forward_rows(call, here, saved, x, out, 0, rows);
  for (long i = 0; i < rows * shape.width[shape.layers]; ++i) out[i] = NAN;
}

// The gradient of a kernel in parts: blocks of its rows in panels of its columns, or of its transpose's where fewer of
// the numbers are padding.
struct Parts {
  bool turned;
  long blocks, panels;
  Parts(const Shape& shape, long l) {
    const long in = shape.width[l], out = shape.width[l + 1];
    turned = out * wide(in) < in * wide(out);
    blocks = ((turned ? out : in) + BLOCK - 1) / BLOCK;
    panels = (wide(turned ? in : out) + PANEL * LANES - 1) / (PANEL * LANES);
  }
};

long gradient_tasks(const Shape& shape) {
  long tasks = 1;
  for (long l = 0; l < shape.layers; ++l) tasks += Parts(shape, l).blocks * Parts(shape, l).panels;
  return tasks;
}

void vector_gradients(const Call& call, const Deltas& deltas, long n) {
  const Shape& shape = call.shape;
  long next = 0;
  const auto give = [&](const float* parts, long count) {
    add_chunks(parts, shape.chunks(), count, call.gradients[next] + n * call.weight_size[next]);
    ++next;
  };
  for (long l = 0; l < shape.layers; ++l) {
    if (shape.normed(l - 1)) give(deltas.scale[l], shape.width[l]), give(deltas.offset[l], shape.width[l]);
    ++next;  // the kernel
    give(deltas.bias[l], shape.width[l + 1]);
  }
}

void backward_task(void* data, int phase, long index) {
  const Call& call = *(const Call*)data;
  const Shape& shape = call.shape;
  const long tasks = phase ? gradient_tasks(shape) : shape.chunks();
  const long n = index / tasks;
  long k = index % tasks;
  Saved saved;
  Deltas deltas;
  saved.place(shape, call.saved + n * call.saved_size);
  deltas.place(shape, call.scratch + n * call.scratch_size);
  if (phase == 0) {
    const long first = k * CHUNK, rows = least(CHUNK, shape.rows - first);
    const float* gradient = call.gradient + n * shape.rows * shape.width[shape.layers];
    if (call.activation == RELU) backward<RELU>(shape, saved, deltas, gradient, first, rows);
    else if (call.activation == TANH) backward<TANH>(shape, saved, deltas, gradient, first, rows);
    else backward<ELU>(shape, saved, deltas, gradient, first, rows);
    const long in = shape.width[0];
    for (long r = first; shape.through && r < first + rows; ++r) {
      memcpy(call.input_gradient + (n * shape.rows + r) * in, deltas.input + r * wide(in), in * sizeof(float));
    }
    return;
  }
  long which = shape.input_norm ? 2 : 0;
  for (long l = 0; l < shape.layers; ++l) {
    const Parts parts(shape, l);
    const long here = parts.blocks * parts.panels;
    if (k < here) {
      return kernel_gradient(shape, saved, deltas, l, k % parts.blocks * BLOCK, k / parts.blocks * PANEL * LANES,
                             parts.turned, call.gradients[which] + n * call.weight_size[which]);
    }
    k -= here;
    which += shape.normed(l) ? 4 : 2;
  }
  vector_gradients(call, deltas, n);
}

// Fills in what all calls have in common; false if the arrays are not a network's. Attributes in the order of their
// names: activation, input_norm, layer_norm, layers, through.
bool read(const XLA_FFI_CallFrame* frame, long first, Call& call) {
  Shape& shape = call.shape;
  if (frame->attrs.size != 5) return false;
  call.activation = native::attribute(frame, 0);
  shape.input_norm = native::attribute(frame, 1), shape.layer_norm = native::attribute(frame, 2);
  shape.layers = native::attribute(frame, 3), shape.through = native::attribute(frame, 4);
  if (shape.layers < 1 || shape.layers > MOST_LAYERS || frame->args.size != first + shape.weights()) return false;
  for (long k = 0; k < shape.weights(); ++k) {
    call.weights[k] = floats(operand(frame, first + k));
    if (!call.weights[k]) return false;
  }
  long k = first + (shape.input_norm ? 2 : 0);
  for (long l = 0; l < shape.layers; ++l) {
    const XLA_FFI_Buffer* kernel = operand(frame, k);
    if (kernel->rank < 2) return false;
    shape.width[l] = kernel->dims[kernel->rank - 2], shape.width[l + 1] = kernel->dims[kernel->rank - 1];
    if (l == 0) call.networks = native::size_of_array(kernel) / (shape.width[0] * shape.width[1]);
    k += shape.normed(l) ? 4 : 2;
  }
  for (long w = 0; w < shape.weights(); ++w) {
    call.weight_size[w] = native::size_of_array(operand(frame, first + w)) / call.networks;
  }
  return true;
}

bool has(const XLA_FFI_Buffer* buffer, long size) {
  return buffer->dtype == XLA_FFI_DataType_F32 && native::size_of_array(buffer) == size;
}

}  // namespace

// x [..., R, in] and weights [..., ...] to outputs [..., R, out] and memory [..., size]: for the packed weights, or with
// them for all that a backward pass needs. Which of both it is, its size says.
EXPORTED XLA_FFI_Error* mlp_forward(XLA_FFI_CallFrame* frame) {
  if (native::is_query(frame)) return nullptr;
  Call call;
  if (!read(frame, 1, call) || frame->rets.size != 2) return native::failure(frame->api, "mlp_forward: wrong arguments");
  Shape& shape = call.shape;
  shape.rows = native::size_of_array(operand(frame, 0)) / (call.networks * shape.width[0]);
  Saved saved;
  call.saved_size = native::size_of_array(result(frame, 1)) / call.networks;
  shape.gradient = call.saved_size == saved.place(shape, nullptr);
  if (!shape.gradient) call.saved_size = saved.Packed::place(shape, nullptr);
  call.x = floats(operand(frame, 0));
  call.out = (float*)result(frame, 0)->data, call.saved = (float*)result(frame, 1)->data;
  if (!has(operand(frame, 0), call.networks * shape.rows * shape.width[0]) ||
      !has(result(frame, 0), call.networks * shape.rows * shape.width[shape.layers]) ||
      !has(result(frame, 1), call.networks * call.saved_size)) {
    return native::failure(frame->api, "mlp_forward: wrong shapes or types");
  }
  return native::run(frame, forward_task, &call, {call.networks * shape.layers, call.networks * shape.chunks()}, 0);
}

// The gradient of outputs [..., R, out], what the forward pass saved and the weights to those of the weights, that of x
// if it has one, and scratch memory.
EXPORTED XLA_FFI_Error* mlp_backward(XLA_FFI_CallFrame* frame) {
  if (native::is_query(frame)) return nullptr;
  Call call;
  if (!read(frame, 2, call) || frame->rets.size != call.shape.weights() + 1 + call.shape.through) {
    return native::failure(frame->api, "mlp_backward: wrong arguments");
  }
  Shape& shape = call.shape;
  shape.rows = native::size_of_array(operand(frame, 0)) / (call.networks * shape.width[shape.layers]);
  Saved saved;
  Deltas deltas;
  call.saved_size = saved.place(shape, nullptr), call.scratch_size = deltas.place(shape, nullptr);
  call.gradient = floats(operand(frame, 0)), call.saved = (float*)operand(frame, 1)->data;
  const long count = shape.weights(), last = count + shape.through;
  call.input_gradient = (float*)result(frame, count)->data, call.scratch = (float*)result(frame, last)->data;
  bool right = has(operand(frame, 0), call.networks * shape.rows * shape.width[shape.layers]) &&
               has(operand(frame, 1), call.networks * call.saved_size) &&
               has(result(frame, last), call.networks * call.scratch_size);
  if (shape.through) right &= has(result(frame, count), call.networks * shape.rows * shape.width[0]);
  for (long k = 0; k < count; ++k) {
    call.gradients[k] = (float*)result(frame, k)->data;
    right &= has(result(frame, k), call.networks * call.weight_size[k]);
  }
  if (!right) return native::failure(frame->api, "mlp_backward: wrong shapes or types");
  const long gradients = call.networks * gradient_tasks(shape);
  return native::run(frame, backward_task, &call, {call.networks * shape.chunks(), gradients}, 0);
}

// Learning rate, bound of the norm and number of steps so far, all [...], then weights, moments and gradients of each
// leaf to new weights and moments of each, the number of steps and the gradient's norm.
EXPORTED XLA_FFI_Error* adam_step(XLA_FFI_CallFrame* frame) {
  if (native::is_query(frame)) return nullptr;
  return adam::call(frame);
}

// gates [..., B, T, 3H], hidden [..., B, H], going [..., B, T], kernel [..., H, 3H] and bias [..., H] to states
// [..., B, T, H], what a backward pass needs [..., B, T, 4H] or nothing [..., 0], and memory for the packed kernel.
EXPORTED XLA_FFI_Error* gru_forward(XLA_FFI_CallFrame* frame) {
  if (native::is_query(frame)) return nullptr;
  gru::Call call = {};
  if (frame->args.size != 5 || frame->rets.size != 3 || !gru::sizes(operand(frame, 0), call)) {
    return native::failure(frame->api, "gru_forward: wrong arguments");
  }
  call.gates = floats(operand(frame, 0)), call.hidden = floats(operand(frame, 1)), call.going = floats(operand(frame, 2));
  call.kernel = floats(operand(frame, 3)), call.bias = floats(operand(frame, 4));
  const long kept = native::size_of_array(result(frame, 1));
  call.new_states = (float*)result(frame, 0)->data, call.new_saved = kept ? (float*)result(frame, 1)->data : nullptr;
  call.packed = (float*)result(frame, 2)->data;
  const long rows = call.networks * call.sequences, h = call.width;
  if (!has(operand(frame, 1), rows * h) || !has(operand(frame, 2), rows * call.steps) || !call.gates ||
      !has(operand(frame, 3), call.networks * 3 * h * h) || !has(operand(frame, 4), call.networks * h) ||
      !has(result(frame, 0), rows * call.steps * h) || !has(result(frame, 1), kept ? rows * call.steps * 4 * h : 0) ||
      !has(result(frame, 2), call.networks * call.packed_size())) {
    return native::failure(frame->api, "gru_forward: wrong shapes or types");
  }
  return native::run(frame, gru::task, &call, {call.networks * 3, call.networks * call.tasks()}, 0);
}

// The gradient of states [..., B, T, H], these, what the forward pass saved, hidden, going and kernel to the gradients of
// gates [..., B, T, 3H], of the kernel and of the bias, and scratch memory [..., size].
EXPORTED XLA_FFI_Error* gru_backward(XLA_FFI_CallFrame* frame) {
  if (native::is_query(frame)) return nullptr;
  gru::Call call = {};
  if (frame->args.size != 6 || frame->rets.size != 4 || !gru::sizes(result(frame, 0), call)) {
    return native::failure(frame->api, "gru_backward: wrong arguments");
  }
  call.gradient = floats(operand(frame, 0)), call.states = floats(operand(frame, 1));
  call.saved = floats(operand(frame, 2)), call.hidden = floats(operand(frame, 3));
  call.going = floats(operand(frame, 4)), call.kernel = floats(operand(frame, 5));
  call.gate_gradient = (float*)result(frame, 0)->data, call.kernel_gradient = (float*)result(frame, 1)->data;
  call.bias_gradient = (float*)result(frame, 2)->data;
  call.packed = (float*)result(frame, 3)->data, call.scratch = call.packed + call.networks * call.packed_size();
  const long rows = call.networks * call.sequences, h = call.width;
  if (!has(operand(frame, 0), rows * call.steps * h) || !has(operand(frame, 1), rows * call.steps * h) ||
      !has(operand(frame, 2), rows * call.steps * 4 * h) || !has(operand(frame, 3), rows * h) ||
      !has(operand(frame, 4), rows * call.steps) || !has(operand(frame, 5), call.networks * 3 * h * h) ||
      !has(result(frame, 1), call.networks * 3 * h * h) || !has(result(frame, 2), call.networks * h) ||
      !has(result(frame, 3), call.networks * (call.packed_size() + call.scratch_size()))) {
    return native::failure(frame->api, "gru_backward: wrong shapes or types");
  }
  const long gradients = call.networks * (1 + call.gradient_tasks());
  return native::run(frame, gru::task, &call, {call.networks * 3, call.networks * call.tasks(), gradients}, 0);
}
