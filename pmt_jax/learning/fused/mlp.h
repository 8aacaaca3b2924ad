// A network of the learner (`networks.MLP`): its layers, and where what they need lies in memory. All numbers of rows
// lie in rows of padded widths, filled up with zeros.
#pragma once
#include "activations.h"
#include "matmul.h"

constexpr int MOST_LAYERS = 16;
constexpr long CHUNK = 48;    // rows that a thread takes at once

// Weights of a normalisation, or nothing.
struct Norm {
  const float *scale, *bias;
};

struct Layer {
  long in, out;
  const float *kernel, *bias;
  Norm norm;  // of what comes out
};

// What is the same for all networks of a call.
struct Shape {
  long rows, layers;
  long width[MOST_LAYERS + 1];  // of the input, of what each layer gives
  bool layer_norm, input_norm;
  bool through;   // whether the input has a gradient
  bool gradient;  // whether a backward pass follows

  long chunks() const { return (rows + CHUNK - 1) / CHUNK; }
  bool to_input() const { return input_norm || through; }  // whether the backward pass goes so far
  bool normed(long layer) const { return layer < 0 ? input_norm : layer_norm && layer + 1 < layers; }
  long weights() const { return 2 * layers + 2 * (input_norm + (layer_norm ? layers - 1 : 0)); }
};

// Pieces of a block of memory, one after the other.
struct Pieces {
  float* at;
  float* take(long size) {
    float* piece = at;
    at += size;
    return piece;
  }
};

// Weights as the passes read them, of one network.
struct Packed {
  float *packed[MOST_LAYERS], *turned[MOST_LAYERS];         // kernels [in, out] and their transposes
  float *bias[MOST_LAYERS], *ones[MOST_LAYERS];             // ones [width]: 1 in its first columns, 0 in the padding
  float *scale[MOST_LAYERS], *offset[MOST_LAYERS];          // of the norm before layer l

  // Where everything lies in a block; returns its size.
  long place(const Shape& shape, float* block) {
    Pieces pieces = {block};
    for (long l = 0; l < shape.layers; ++l) {
      const long in = shape.width[l], out = shape.width[l + 1];
      packed[l] = pieces.take(in * wide(out));
      turned[l] = pieces.take(out * wide(in));
      bias[l] = pieces.take(wide(out));
      ones[l] = pieces.take(wide(in));
      scale[l] = pieces.take(wide(in));
      offset[l] = pieces.take(wide(in));
    }
    return pieces.at - block;
  }
};

// What the forward pass leaves to the backward pass, of one network.
struct Saved : Packed {
  float *active[MOST_LAYERS], *moments[MOST_LAYERS];  // before the norm before layer l; its mean and 1 / sd [rows, 2]
  float *input[MOST_LAYERS], *head;                   // of layer l; what the last one gives, without its bias

  long place_rows(const Shape& shape, float* block) {
    Pieces pieces = {block};
    for (long l = 0; l < shape.layers; ++l) {
      const long in = wide(shape.width[l]);
      input[l] = pieces.take(shape.rows * in);
      active[l] = shape.normed(l - 1) ? pieces.take(shape.rows * in) : input[l];
      moments[l] = pieces.take(wide(2 * shape.rows));
    }
    head = pieces.take(shape.rows * wide(shape.width[shape.layers]));
    return pieces.at - block;
  }
  long place(const Shape& shape, float* block) {
    const long weights = Packed::place(shape, block);
    return weights + place_rows(shape, block + weights);
  }
};

// What the backward pass needs for itself, of one network.
struct Deltas {
  float *delta[MOST_LAYERS], *input;                                      // of layer l's outputs, of the input
  float *bias[MOST_LAYERS], *scale[MOST_LAYERS], *offset[MOST_LAYERS];    // sums over each chunk [chunks, width]

  long place(const Shape& shape, float* block) {
    Pieces pieces = {block};
    for (long l = 0; l < shape.layers; ++l) {
      const long in = wide(shape.width[l]), out = wide(shape.width[l + 1]);
      delta[l] = pieces.take(shape.rows * out);
      bias[l] = pieces.take(shape.chunks() * out);
      scale[l] = pieces.take(shape.chunks() * in);
      offset[l] = pieces.take(shape.chunks() * in);
    }
    input = pieces.take(shape.to_input() ? shape.rows * wide(shape.width[0]) : 0);
    return pieces.at - block;
  }
};
