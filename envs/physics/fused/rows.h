// Rows of the tables that header.py writes for a model. See model.py for what they mean.
#pragma once
#include "vector.h"

enum { SLIDE = 0, HINGE = 1, SHIFT = 2, FREE = 3 };
enum { XPOS, XQUAT, XMAT, XIPOS, SUBTREE_COM, CINERT, CVEL, CFRC_EXT, QFRC_ACTUATOR, QACC };

struct ImpedanceRow {
  Real stiffness, damping, lowest, highest, inverse_width;
};
struct ContactRow {
  int dims;
  Real friction[5], margin;
  ImpedanceRow impedance;
  Real regularisation;
};
struct BodyRow {
  int parent, first_joint, last_joint;  // its joints are those from first to before last
  Real mass, com[3], inertia[6];        // about the centre of mass: xx yy zz xy xz yz
  int axial;                            // inertia = across E + along axis axis'
  Real across, along, axis[3], subtree_mass;
};
struct JointRow {
  int kind, body, qpos, dof, turns, moves;  // whether `rotation` is not the identity, `position` not zero
  Real reference, axis[3], anchor[3], position[3], rotation[9], quat[4];
};
struct PlaceRow {
  int body, root, moves;
  Real position[3], rotation[9], quat[4], mass, com[3], inertia[6];
};
struct BoxRow {
  int body;
  Real centre[3], axes[9], size[3];
};
struct PointRow {
  int body, place, capsule, corner;  // 1 to 8 of a box
  Real centre[3], axis[3], radius, height;
  ContactRow contact;
};
struct SegmentRow {
  int body, place, capsule;
  Real centre[3], half[3], side[3], radius;
};
struct BlockRow {
  int body, place, first_pair, last_pair;  // its pairs are those from first to before last
  Real axes[9], offset[3], size[3], reach;
};
struct PairRow {
  int first, second, columns, rooted;  // whether the first columns are the root's
  Real reach;                          // m, between the middles, or a middle and a block: further apart they cannot touch
  ContactRow contact;
};
struct LimitRow {
  int qpos, dof;
  Real low, high, margin;
  ImpedanceRow impedance;
  Real inverse_weight;
};
struct MotorRow {
  int dof, qpos, body;  // -1: it acts at a site of the body
  Real place[3], push[3], turn[3], gear, gain, low, high, bias[3], weakest, strongest;
};
struct ReadingRow {
  int field, row;
};
