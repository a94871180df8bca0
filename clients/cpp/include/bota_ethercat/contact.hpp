// SPDX-License-Identifier: Apache-2.0
// Contact: whether something touches the tool, and where on its surface, from a compensated wrench. No allocation, no locks.
// As ros2_bridge/bota_ft_compensation/contact.py, which has the method; docs/compensation.md.
#pragma once

#include <algorithm>
#include <cmath>
#include <optional>

#include "bota_ethercat/protocol.hpp"

namespace bota_ethercat {

/// Why there is no point.
enum class Why { point, no_contact, free_moment, too_weak, off_surface };

/// In the sensor's frame, m: a capsule (all within `radius` of the segment from `start` to `end`; a sphere if they are the same),
/// or, with a `normal` (of length 1, out of the tool), a disk around `start`. A capsule is pressed, not pulled.
struct Surface {
    Vector3 start{}, end{};
    double radius = 0.0;
    std::optional<Vector3> normal{};
};

/// Standard deviations of what is not contact in one compensated sample.
struct Uncertainty {
    double force = 0.0;   ///< N, of each axis
    Vector3 torque{};     ///< Nm
    double tool = 0.0;    ///< N on each axis, at `center`: of what is not known of the tool's weight
    Vector3 center{};     ///< m
    double spin = 0.0;    ///< Nm for each rad/s^2 of the sensor: inertia that is not known
    double motion = 0.0;  ///< N, as `tool`, for the decision only: the extremes of motion
};

/// Where the contact is. The 95 % region is an ellipse in the plane through `center` that touches the surface: x from the center,
/// along u and v, is within if x^T M^-1 x <= 1, M = (uu uv, uv vv), m^2.
struct Contact {
    Why why = Why::no_contact;  ///< anything but `point`: nothing else holds
    bool is_press = true;       ///< towards the tool; a pull if not
    Vector3 point{};            ///< the likeliest, m
    Vector3 center{}, normal{}, u{}, v{};
    double uu = 0.0, uv = 0.0, vv = 0.0;
};

namespace detail {

inline double dot(const Vector3& a, const Vector3& b) noexcept { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
inline Vector3 sum(const Vector3& a, const Vector3& b, double times = 1.0) noexcept {
    return {a[0] + times * b[0], a[1] + times * b[1], a[2] + times * b[2]};
}
inline Vector3 vector_product(const Vector3& a, const Vector3& b) noexcept {
    return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}
inline double length(const Vector3& a) noexcept { return std::sqrt(dot(a, a)); }

}  // namespace detail

/// `update` says whether samples are contact, `locate` where.
class ContactDetector {
public:
    /// All but `correlation` (of the noise of one sample and the next) above 0; `uncertainty` as Python's `Uncertainty.of` has it.
    ContactDetector(const Surface& surface, const Uncertainty& uncertainty, double rate_hz, double correlation = 0.0,
                    double alarms_per_hour = 1.0)
        : surface_(surface), known_(uncertainty) {
        const double share = alarms_per_hour / 3600.0 / rate_hz;
        const auto of_six = [](double u) { return std::exp(-u * u / 2) * (1.0 + u * u / 2 + u * u * u * u / 8); };
        level_ = level(of_six, share, correlation);
        moment_level_ = level([](double u) { return std::erfc(u * std::sqrt(0.5)); }, share, correlation);
        // About a point this far to the tool's center of gravity errors of force and torque are independent.
        const double deviation = std::max(known_.tool, known_.motion), tool = deviation * deviation, noise = known_.force * known_.force;
        const Vector3& center = known_.center;
        force_variance_ = noise + tool;
        pivot_ = detail::sum({}, center, tool / force_variance_);
        for (std::size_t i = 0; i < 3; ++i)
            torque_variance_[i] = known_.torque[i] * known_.torque[i] +
                                  tool * noise / force_variance_ * (detail::dot(center, center) - center[i] * center[i]);
        const double ends = std::max(detail::length(surface.start), surface.normal ? 0.0 : detail::length(surface.end));
        reach_ = ends + surface.radius;
    }

    bool is_contact() const noexcept { return is_contact_; }

    /// Whether a compensated sample, N and Nm, is contact, while the sensor turns so, rad/s and rad/s^2.
    bool update(const Vector3& force, const Vector3& torque, const Vector3& rate = {}, const Vector3& spin = {}) noexcept {
        const double spun = spun_by(rate, spin);
        double size = detail::dot(force, force) / force_variance_;
        const Vector3 about = detail::sum(torque, detail::vector_product(pivot_, force), -1.0);
        for (std::size_t i = 0; i < 3; ++i) size += about[i] * about[i] / (torque_variance_[i] + spun);
        return is_contact_ = size > (is_contact_ ? kRelease : level_);
    }

    /// Where the latest sample of `update` is contact.
    Contact locate(const Vector3& force, const Vector3& torque, const Vector3& rate = {}, const Vector3& spin = {}) const noexcept {
        using namespace detail;
        if (!is_contact_) return {};
        const double a = known_.force * known_.force, tool = known_.tool * known_.tool, spun = spun_by(rate, spin);
        const Vector3& heavy = known_.center;
        Vector3 b = known_.torque;
        for (double& each : b) each = each * each + spun;
        const auto weighted = [&b](const Vector3& x, const Vector3& y) {
            return b[0] * x[0] * y[0] + b[1] * x[1] * y[1] + b[2] * x[2] * y[2];
        };
        const double ff = dot(force, force), mm = dot(torque, torque), least = kRegion * (a + tool);
        if (ff < least) {
            const double farthest = (std::sqrt(ff) + std::sqrt(least)) * reach_;
            return none(mm > farthest * farthest ? Why::free_moment : Why::too_weak);
        }
        const Vector3 turned = sum(torque, vector_product(heavy, force), -1.0);
        const double spread = weighted(force, force) + a * mm + tool * dot(turned, turned), along = dot(force, torque);
        if (along * along > moment_level_ * spread) return none(Why::free_moment);
        Hit hit{surface_.start, surface_.normal.value_or(Vector3{}), false};
        if (!surface_.normal && !first_hit(surface_.radius, force, torque, hit)) {
            const double slack = std::sqrt(kRegion * (*std::max_element(b.begin(), b.end()) + (a + tool) * reach_ * reach_) / ff);
            return none(first_hit(surface_.radius + slack, force, torque, hit) ? Why::too_weak : Why::off_surface);
        }
        const Vector3 n = hit.normal, u = hit.is_side ? axis() : tangent(n), v = vector_product(n, u);
        const double fn = dot(force, n), d = dot(hit.at, n), away = d - dot(heavy, n);
        if (fn * fn <= least) return none(Why::too_weak);
        const double qu = d * dot(force, u) - dot(torque, v), qv = d * dot(force, v) + dot(torque, u), pu = qu / fn, pv = qv / fn;
        const double ru = pu - dot(heavy, u), rv = pv - dot(heavy, v), both = a * d * d + tool * away * away;
        const double suu = both + tool * ru * ru + weighted(v, v), svv = both + tool * rv * rv + weighted(u, u);
        const double suv = tool * ru * rv - weighted(u, v), rest = fn * fn - kRegion * a;
        const double guu = rest * svv + a * qv * qv, guv = -rest * suv - a * qu * qv, gvv = rest * suu + a * qu * qu;
        const double hu = fn * (svv * qu - suv * qv), hv = fn * (suu * qv - suv * qu), det = guu * gvv - guv * guv;
        const double eu = (gvv * hu - guv * hv) / det, ev = (guu * hv - guv * hu) / det;
        const double size = (hu * (eu - pu) + hv * (ev - pv) + kRegion * (suu * svv - suv * suv)) / det;
        const auto at = [&](double x, double y) { return sum(sum(sum({}, n, d), u, x), v, y); };
        const Contact found{Why::point, fn < 0.0, at(pu, pv), at(eu, ev), n, u, v, size * gvv, -size * guv, size * guu};
        const double largest = std::sqrt(0.5 * (found.uu + found.vv) + std::hypot(0.5 * (found.uu - found.vv), found.uv));
        if (surface_.normal) {
            const double beyond = length(sum(found.center, hit.at, -1.0)) - surface_.radius;
            return beyond > 0.0 && beyond > largest ? none(Why::off_surface) : found;
        }
        return (hit.is_side ? std::sqrt(found.vv) : largest) > surface_.radius ? none(Why::too_weak) : found;
    }

private:
    struct Hit {
        Vector3 at{}, normal{};
        bool is_side = false;  // of the capsule, not an end
    };
    static constexpr double kRelease = 12.592, kRegion = 5.991;  // chi squared that 95 % keep to, with 6 and 2 degrees of freedom

    static Contact none(Why why) noexcept { return Contact{why}; }

    template <typename Share>
    static double level(Share share, double alarms_per_sample, double correlation) {
        double low = 0.0, high = 40.0;
        for (int i = 0; i < 60; ++i) {
            const double u = 0.5 * (low + high), crossing = std::min(1.0, u * std::sqrt((1.0 - correlation) / std::acos(-1.0)));
            (share(u) * crossing > alarms_per_sample ? low : high) = u;
        }
        return high * high;
    }

    double spun_by(const Vector3& rate, const Vector3& spin) const noexcept {
        const double square = detail::dot(rate, rate);
        return known_.spin * known_.spin * (detail::dot(spin, spin) + square * square);
    }

    Vector3 axis() const noexcept {
        const Vector3 whole = detail::sum(surface_.end, surface_.start, -1.0);
        const double high = detail::length(whole);
        return high > 0.0 ? detail::sum({}, whole, 1.0 / high) : whole;
    }

    static Vector3 tangent(const Vector3& n) noexcept {
        const Vector3 u = detail::vector_product(n, std::abs(n[0]) < 0.7 ? Vector3{1, 0, 0} : Vector3{0, 1, 0});
        return detail::sum({}, u, 1.0 / detail::length(u));
    }

    /// Where the line of action enters, by Newton's method: the distance is convex, and it comes from outside.
    bool first_hit(double radius, const Vector3& force, const Vector3& torque, Hit& hit) const noexcept {
        using namespace detail;
        const double ff = dot(force, force), high = length(sum(surface_.end, surface_.start, -1.0));
        const Vector3 along = sum({}, force, 1.0 / std::sqrt(ff)), side = axis();
        const Vector3 foot = sum(sum({}, vector_product(force, torque), 1.0 / ff), surface_.start, -1.0);
        const double slope = dot(along, side), up = dot(foot, side);
        double t = -length(foot) - high - radius;
        for (int i = 0; i < 100; ++i) {
            const double at = std::min(std::max(up + t * slope, 0.0), high);
            const Vector3 away = sum(sum(foot, along, t), side, -at);
            const double distance = length(away), gap = distance - radius, nearing = -dot(away, along) / distance;
            if (gap < 1e-9 * radius) {
                hit = {sum(sum(surface_.start, foot), along, t), sum({}, away, 1.0 / distance), at > 0.0 && at < high};
                return true;
            }
            if (nearing <= 0.0) break;
            t += gap / nearing;
        }
        return false;
    }

    Surface surface_;
    Uncertainty known_;
    double level_ = 0.0, moment_level_ = 0.0, force_variance_ = 0.0, reach_ = 0.0;
    Vector3 pivot_{}, torque_variance_{};
    bool is_contact_ = false;
};

}  // namespace bota_ethercat
