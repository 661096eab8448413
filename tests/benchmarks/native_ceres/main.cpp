// Ceres on the problem of v2hdm.adjust, written for it: analytic derivatives, and all that does not depend on
// the observation computed once an evaluation.
//
//   native_ceres PROBLEM RESULT LINEAR_SOLVER THREADS TOLERANCE MAX_STEPS BLOCKS
//
// BLOCKS is "single", a residual block for each observation, or "batched", one for all observations of a corner by
// a camera: as fast again, since Ceres handles fewer blocks. A batch has no robust loss, which Ceres applies to whole
// blocks, and no frame poses, of which every observation has another.
//
// PROBLEM is what native.py writes; RESULT holds the adjusted cameras (C, 4, 4) and corners (N, 2). One line on
// stdout: set-up, solve and CPU seconds (those of ceres::Solve alone), cost, steps taken or tried, and how it ended.
//
// Unknown are, as left tangents (translation, rotation), the cameras: cam_from_vehicle = exp(x) start; the corners;
// and, where the problem says so, a tangent s of each frame: exp(-s) vehicle_from_map.

#include <ceres/ceres.h>
#include <sys/resource.h>

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <memory>
#include <string>
#include <vector>

namespace {

using Matrix3 = Eigen::Matrix3d;
using Vector3 = Eigen::Vector3d;
using Matrix6 = Eigen::Matrix<double, 6, 6, Eigen::RowMajor>;
using Row6 = Eigen::Matrix<double, 1, 6>;

struct Transform {
  Matrix3 rotation = Matrix3::Identity();
  Vector3 translation = Vector3::Zero();
};

Transform operator*(const Transform& a, const Transform& b) {
  return {a.rotation * b.rotation, a.rotation * b.translation + a.translation};
}

Matrix3 Hat(const Vector3& v) {
  Matrix3 m;
  m << 0, -v.z(), v.y(), v.z(), 0, -v.x(), -v.y(), v.x(), 0;
  return m;
}

// Coefficients of I, W and W^2 in the integral of a rotation vector's exponential.
Matrix3 IntegralOfRotation(const Vector3& w) {
  const double t2 = w.squaredNorm(), t = std::sqrt(t2);
  const double a = t < 1e-4 ? 0.5 - t2 / 24 : (1 - std::cos(t)) / t2;
  const double b = t < 1e-4 ? 1.0 / 6 - t2 / 120 : (t - std::sin(t)) / (t2 * t);
  const Matrix3 W = Hat(w);
  return Matrix3::Identity() + a * W + b * W * W;
}

Transform Exp(const double* x) {
  const Vector3 shift(x[0], x[1], x[2]), turn(x[3], x[4], x[5]);
  const double t = turn.norm();
  Transform out;
  if (t > 0) out.rotation = Eigen::AngleAxisd(t, turn / t).toRotationMatrix();
  out.translation = IntegralOfRotation(turn) * shift;
  return out;
}

// exp(x + dx) = exp(LeftJacobian(x) dx) exp(x): the series of ad^n / (n + 1)!, for the small tangents met here.
Matrix6 LeftJacobian(const double* x) {
  Matrix6 ad = Matrix6::Zero();
  const Matrix3 W = Hat({x[3], x[4], x[5]});
  ad.topLeftCorner<3, 3>() = W;
  ad.bottomRightCorner<3, 3>() = W;
  ad.topRightCorner<3, 3>() = Hat({x[0], x[1], x[2]});
  Matrix6 out = Matrix6::Identity(), power = Matrix6::Identity();
  double factorial = 1;
  for (int n = 1; n < 20; ++n) {
    power = (power * ad).eval();
    factorial *= n + 1;
    out += power / factorial;
    if (power.cwiseAbs().maxCoeff() < 1e-18 * factorial) break;
  }
  return out;
}

Matrix6 Adjoint(const Transform& t) {
  Matrix6 out = Matrix6::Zero();
  out.topLeftCorner<3, 3>() = t.rotation;
  out.bottomRightCorner<3, 3>() = t.rotation;
  out.topRightCorner<3, 3>() = Hat(t.translation) * t.rotation;
  return out;
}

struct Observation {
  int32_t camera, frame, corner;
  double measured[2];  // at depth 1
  double root[3];      // a, b, c: whitened residual (a dx, b dx + c dy)
};

struct Data {
  int64_t cameras = 0, frames = 0, corners = 0, observations = 0, frame_poses = 0;
  double cauchy_scale = 0;
  std::vector<Transform> start, vehicle_from_map;
  std::vector<double> centre, centre_root, state_root, corner;
  std::vector<Observation> seen;
  std::vector<double> camera_tangent, frame_tangent;  // the unknowns, beside `corner`
};

void Read(std::ifstream& in, void* to, size_t bytes) {
  if (!in.read(static_cast<char*>(to), static_cast<std::streamsize>(bytes))) {
    std::fprintf(stderr, "error: the problem's file ends too early\n");
    std::exit(2);
  }
}

std::vector<Transform> ReadTransforms(std::ifstream& in, int64_t count) {
  std::vector<Transform> out(count);
  for (auto& transform : out) {
    Eigen::Matrix<double, 4, 4, Eigen::RowMajor> matrix;
    Read(in, matrix.data(), sizeof(double) * 16);
    transform = {matrix.topLeftCorner<3, 3>(), matrix.topRightCorner<3, 1>()};
  }
  return out;
}

std::vector<double> ReadDoubles(std::ifstream& in, int64_t count) {
  std::vector<double> out(count);
  Read(in, out.data(), sizeof(double) * count);
  return out;
}

Data ReadProblem(const char* path) {
  std::ifstream in(path, std::ios::binary);
  Data data;
  int64_t header[5];
  Read(in, header, sizeof(header));
  data.cameras = header[0], data.frames = header[1], data.corners = header[2];
  data.observations = header[3], data.frame_poses = header[4];
  data.cauchy_scale = ReadDoubles(in, 1)[0];
  data.start = ReadTransforms(in, data.cameras);
  data.vehicle_from_map = ReadTransforms(in, data.frames);
  data.centre = ReadDoubles(in, 3 * data.cameras);
  data.centre_root = ReadDoubles(in, 3 * data.cameras);
  data.state_root = ReadDoubles(in, 6);
  data.corner = ReadDoubles(in, 2 * data.corners);
  data.seen.resize(data.observations);
  std::vector<int32_t> index(3 * data.observations);
  Read(in, index.data(), sizeof(int32_t) * index.size());
  const auto number = ReadDoubles(in, 5 * data.observations);
  for (int64_t k = 0; k < data.observations; ++k) {
    data.seen[k] = {index[3 * k], index[3 * k + 1], index[3 * k + 2], {}, {}};
    std::memcpy(data.seen[k].measured, &number[5 * k], sizeof(double) * 5);
  }
  data.camera_tangent.assign(6 * data.cameras, 0.0);
  data.frame_tangent.assign(6 * data.frames, 0.0);
  return data;
}

// What all observations of a (camera, frame) pair share, computed once an evaluation.
struct Pair {
  Matrix3 columns;   // r1, r2, t of cam_from_map
  Matrix6 by_frame;  // the pair's left tangent by the frame's
};

struct Tables : ceres::EvaluationCallback {
  explicit Tables(const Data& data)
      : data(data), camera(data.cameras), by_camera(data.cameras), pair(data.cameras * data.frames) {}

  void PrepareForEvaluation(bool jacobians, bool new_point) override {
    if (!new_point && !jacobians) return;
    for (int64_t c = 0; c < data.cameras; ++c) {
      camera[c] = Exp(&data.camera_tangent[6 * c]) * data.start[c];
      by_camera[c] = LeftJacobian(&data.camera_tangent[6 * c]);
    }
    for (int64_t j = 0; j < data.frames; ++j) {
      Transform vehicle = data.vehicle_from_map[j];
      Matrix6 by_state = Matrix6::Zero();
      if (data.frame_poses) {
        double back[6];
        for (int i = 0; i < 6; ++i) back[i] = -data.frame_tangent[6 * j + i];
        vehicle = Exp(back) * vehicle;
        if (jacobians) by_state = LeftJacobian(back);
      }
      for (int64_t c = 0; c < data.cameras; ++c) {
        Pair& one = pair[c * data.frames + j];
        const Transform seen = camera[c] * vehicle;
        one.columns << seen.rotation.col(0), seen.rotation.col(1), seen.translation;
        if (data.frame_poses && jacobians) one.by_frame = -Adjoint(camera[c]) * by_state;
      }
    }
  }

  const Data& data;
  std::vector<Transform> camera;
  std::vector<Matrix6> by_camera;
  std::vector<Pair> pair;
};

// The whitened residual of an observation, and its derivatives by camera, corner and, if it is free, frame.
template <int... kBlocks>
class Reprojection : public ceres::SizedCostFunction<2, 6, 2, kBlocks...> {
 public:
  Reprojection(const Tables& tables, const Observation& seen)
      : seen_(seen), pair_(tables.pair[seen.camera * tables.data.frames + seen.frame]),
        by_camera_(tables.by_camera[seen.camera]) {}

  bool Evaluate(double const* const* x, double* residual, double** jacobians) const override {
    const Vector3 point = pair_.columns * Vector3(x[1][0], x[1][1], 1.0);
    if (!(point.z() > 1e-3)) return false;
    const double inverse = 1 / point.z(), u = point.x() * inverse, v = point.y() * inverse;
    const double a = seen_.root[0], b = seen_.root[1], c = seen_.root[2];
    const double du = u - seen_.measured[0], dv = v - seen_.measured[1];
    residual[0] = a * du;
    residual[1] = b * du + c * dv;
    if (jacobians == nullptr) return true;
    Eigen::Matrix<double, 2, 3> by_point;
    by_point << a * inverse, 0, -a * u * inverse, b * inverse, c * inverse, -(b * u + c * v) * inverse;
    if (jacobians[1] != nullptr) {
      Eigen::Map<Eigen::Matrix<double, 2, 2, Eigen::RowMajor>> by_corner(jacobians[1]);
      by_corner.noalias() = by_point * pair_.columns.leftCols<2>();
    }
    Eigen::Matrix<double, 2, 6, Eigen::RowMajor> by_pair;
    by_pair.leftCols<3>() = by_point;
    by_pair.row(0).tail<3>() = point.cross(by_point.row(0).transpose()).transpose();
    by_pair.row(1).tail<3>() = point.cross(by_point.row(1).transpose()).transpose();
    if (jacobians[0] != nullptr) {
      Eigen::Map<Eigen::Matrix<double, 2, 6, Eigen::RowMajor>> by_camera(jacobians[0]);
      by_camera.noalias() = by_pair * by_camera_;
    }
    if constexpr (sizeof...(kBlocks) > 0) {
      if (jacobians[2] != nullptr) {
        Eigen::Map<Eigen::Matrix<double, 2, 6, Eigen::RowMajor>> by_frame(jacobians[2]);
        by_frame.noalias() = by_pair * pair_.by_frame;
      }
    }
    return true;
  }

 private:
  const Observation& seen_;
  const Pair& pair_;
  const Matrix6& by_camera_;
};

// The whitened residuals of all observations of a corner by a camera, and their derivatives by camera and corner.
class Batch : public ceres::CostFunction {
 public:
  Batch(const Tables& tables, const Observation* seen, int count)
      : seen_(seen), count_(count), pairs_(&tables.pair[seen->camera * tables.data.frames]),
        by_camera_(tables.by_camera[seen->camera]) {
    set_num_residuals(2 * count);
    *mutable_parameter_block_sizes() = {6, 2};
  }

  bool Evaluate(double const* const* x, double* residual, double** jacobians) const override {
    const double east = x[1][0], north = x[1][1];
    double* by_camera = jacobians == nullptr ? nullptr : jacobians[0];
    double* by_corner = jacobians == nullptr ? nullptr : jacobians[1];
    // The left Jacobian of a tangent is [J Q; 0 J].
    const Matrix3 turn = by_camera_.topLeftCorner<3, 3>(), lever = by_camera_.topRightCorner<3, 3>();
    for (int i = 0; i < count_; ++i) {
      const Observation& seen = seen_[i];
      const Matrix3& columns = pairs_[seen.frame].columns;
      const Vector3 point = columns.col(0) * east + columns.col(1) * north + columns.col(2);
      if (!(point.z() > 1e-3)) return false;
      const double inverse = 1 / point.z(), u = point.x() * inverse, v = point.y() * inverse;
      const double a = seen.root[0], b = seen.root[1], c = seen.root[2];
      const double du = u - seen.measured[0], dv = v - seen.measured[1];
      residual[2 * i] = a * du;
      residual[2 * i + 1] = b * du + c * dv;
      if (jacobians == nullptr) continue;
      const Vector3 first(a * inverse, 0, -a * u * inverse);
      const Vector3 second(b * inverse, c * inverse, -(b * u + c * v) * inverse);
      if (by_corner != nullptr) {
        by_corner[4 * i] = first.dot(columns.col(0));
        by_corner[4 * i + 1] = first.dot(columns.col(1));
        by_corner[4 * i + 2] = second.dot(columns.col(0));
        by_corner[4 * i + 3] = second.dot(columns.col(1));
      }
      if (by_camera != nullptr) {
        using Row3 = Eigen::Matrix<double, 1, 3>;
        Eigen::Map<Row3> first_shift(by_camera + 12 * i), first_turn(by_camera + 12 * i + 3);
        Eigen::Map<Row3> second_shift(by_camera + 12 * i + 6), second_turn(by_camera + 12 * i + 9);
        first_shift.noalias() = first.transpose() * turn;
        second_shift.noalias() = second.transpose() * turn;
        first_turn.noalias() = first.transpose() * lever + point.cross(first).transpose() * turn;
        second_turn.noalias() = second.transpose() * lever + point.cross(second).transpose() * turn;
      }
    }
    return true;
  }

 private:
  const Observation* seen_;
  int count_;
  const Pair* pairs_;
  const Matrix6& by_camera_;
};

// The surveyed centre of a camera, o = -R' t.
class Centre : public ceres::SizedCostFunction<3, 6> {
 public:
  Centre(const Tables& tables, int64_t camera) : tables_(tables), camera_(camera) {}

  bool Evaluate(double const* const*, double* residual, double** jacobians) const override {
    const Transform& t = tables_.camera[camera_];
    const double *root = &tables_.data.centre_root[3 * camera_], *centre = &tables_.data.centre[3 * camera_];
    const Vector3 at = -t.rotation.transpose() * t.translation;
    for (int i = 0; i < 3; ++i) residual[i] = root[i] * (at[i] - centre[i]);
    if (jacobians != nullptr && jacobians[0] != nullptr) {
      Eigen::Map<Eigen::Matrix<double, 3, 6, Eigen::RowMajor>> out(jacobians[0]);
      Eigen::Matrix<double, 3, 6> by_left = Eigen::Matrix<double, 3, 6>::Zero();
      by_left.leftCols<3>() = -t.rotation.transpose();
      out = Vector3(root[0], root[1], root[2]).asDiagonal() * by_left * tables_.by_camera[camera_];
    }
    return true;
  }

 private:
  const Tables& tables_;
  int64_t camera_;
};

class StatePrior : public ceres::SizedCostFunction<6, 6> {
 public:
  explicit StatePrior(const double* root) : root_(root) {}

  bool Evaluate(double const* const* x, double* residual, double** jacobians) const override {
    for (int i = 0; i < 6; ++i) residual[i] = root_[i] * x[0][i];
    if (jacobians != nullptr && jacobians[0] != nullptr) {
      std::fill(jacobians[0], jacobians[0] + 36, 0.0);
      for (int i = 0; i < 6; ++i) jacobians[0][7 * i] = root_[i];
    }
    return true;
  }

 private:
  const double* root_;
};

// Adds the observations as BLOCKS says; marks the frames whose poses are unknown.
void AddObservations(Data& data, const Tables& tables, bool batched, ceres::Problem& problem,
                     std::vector<bool>& used) {
  ceres::LossFunction* loss = data.cauchy_scale > 0 ? new ceres::CauchyLoss(data.cauchy_scale) : nullptr;
  const size_t count = data.seen.size();
  for (size_t k = 0; k < count;) {
    const Observation& seen = data.seen[k];
    size_t end = k + 1;
    while (batched && end < count && data.seen[end].camera == seen.camera && data.seen[end].corner == seen.corner) {
      ++end;
    }
    double *camera = &data.camera_tangent[6 * seen.camera], *corner = &data.corner[2 * seen.corner];
    if (batched) {
      problem.AddResidualBlock(new Batch(tables, &seen, static_cast<int>(end - k)), nullptr, camera, corner);
    } else if (data.frame_poses) {
      problem.AddResidualBlock(new Reprojection<6>(tables, seen), loss, camera, corner,
                               &data.frame_tangent[6 * seen.frame]);
      used[seen.frame] = true;
    } else {
      problem.AddResidualBlock(new Reprojection<>(tables, seen), loss, camera, corner);
    }
    k = end;
  }
}

double Cpu() {
  rusage used;
  getrusage(RUSAGE_SELF, &used);
  return used.ru_utime.tv_sec + used.ru_stime.tv_sec + 1e-6 * (used.ru_utime.tv_usec + used.ru_stime.tv_usec);
}

double Now() {
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 8) {
    std::fprintf(stderr, "error: native_ceres PROBLEM RESULT LINEAR_SOLVER THREADS TOLERANCE MAX_STEPS BLOCKS\n");
    return 2;
  }
  Data data = ReadProblem(argv[1]);
  const bool batched = std::strcmp(argv[7], "batched") == 0;
  if (batched && (data.frame_poses || data.cauchy_scale > 0)) {
    std::fprintf(stderr, "error: a batch has neither frame poses nor a robust loss\n");
    return 2;
  }
  const double began = Now();
  Tables tables(data);
  ceres::Problem::Options ownership;
  ownership.evaluation_callback = &tables;
  ownership.disable_all_safety_checks = true;
  ceres::Problem problem(ownership);
  auto order = std::make_shared<ceres::ParameterBlockOrdering>();
  std::vector<bool> used(data.frames, false);
  AddObservations(data, tables, batched, problem, used);
  for (int64_t n = 0; n < data.corners; ++n) order->AddElementToGroup(&data.corner[2 * n], 0);
  for (int64_t c = 0; c < data.cameras; ++c) {
    problem.AddResidualBlock(new Centre(tables, c), nullptr, &data.camera_tangent[6 * c]);
    order->AddElementToGroup(&data.camera_tangent[6 * c], 1);
  }
  for (int64_t j = 0; j < data.frames; ++j) {
    if (!used[j]) continue;
    problem.AddResidualBlock(new StatePrior(data.state_root.data()), nullptr, &data.frame_tangent[6 * j]);
    order->AddElementToGroup(&data.frame_tangent[6 * j], 1);
  }
  ceres::Solver::Options options;
  if (!ceres::StringToLinearSolverType(argv[3], &options.linear_solver_type)) {
    std::fprintf(stderr, "error: no linear solver %s\n", argv[3]);
    return 2;
  }
  options.linear_solver_ordering = order;
  options.preconditioner_type = ceres::SCHUR_JACOBI;
  options.num_threads = std::atoi(argv[4]);
  options.function_tolerance = std::atof(argv[5]);
  options.gradient_tolerance = 0;
  options.parameter_tolerance = 0;
  options.max_num_iterations = std::atoi(argv[6]);
  options.logging_type = ceres::SILENT;
  const double ready = Now(), cpu = Cpu();
  ceres::Solver::Summary summary;
  ceres::Solve(options, &problem, &summary);
  const double took = Now() - ready, spent = Cpu() - cpu;
  tables.PrepareForEvaluation(false, true);
  std::ofstream out(argv[2], std::ios::binary);
  for (const Transform& camera : tables.camera) {
    Eigen::Matrix<double, 4, 4, Eigen::RowMajor> matrix = Eigen::Matrix4d::Identity();
    matrix.topLeftCorner<3, 3>() = camera.rotation;
    matrix.topRightCorner<3, 1>() = camera.translation;
    out.write(reinterpret_cast<const char*>(matrix.data()), sizeof(double) * 16);
  }
  out.write(reinterpret_cast<const char*>(data.corner.data()),
            static_cast<std::streamsize>(sizeof(double) * data.corner.size()));
  std::printf("%.9f %.9f %.9f %.17g %d %s\n", ready - began, took, spent, summary.final_cost,
              summary.num_successful_steps + summary.num_unsuccessful_steps,
              ceres::TerminationTypeToString(summary.termination_type));
  return out ? 0 : 2;
}
