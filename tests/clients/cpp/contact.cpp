// Tells contact of wrenches on standard input, a line each: a surface (start, end, radius, normal or zeros), an uncertainty (force,
// torque, tool, center, spin, motion), force, torque, angular rate and acceleration. For each a line: `update` of a detector
// that was not in contact, then of one that was, and what `locate` says, as numbers.
//
//   --time N             seconds of N calls of `update` and `locate` instead, of each line
#include "bota_ethercat/contact.hpp"

#include <ctime>
#include <cstdio>
#include <cstdlib>
#include <iostream>
#include <sstream>
#include <string>

using namespace bota_ethercat;

static Vector3 vector(std::istream& in) {
    Vector3 v{};
    in >> v[0] >> v[1] >> v[2];
    return v;
}

int main(int count, char** words) {
    const long calls = count > 2 ? std::atol(words[2]) : 0;
    for (std::string line; std::getline(std::cin, line);) {
        std::istringstream in(line);
        Surface surface;
        surface.start = vector(in), surface.end = vector(in), in >> surface.radius;
        if (const Vector3 normal = vector(in); normal != Vector3{}) surface.normal = normal;
        Uncertainty known;
        in >> known.force, known.torque = vector(in), in >> known.tool, known.center = vector(in), in >> known.spin >> known.motion;
        const Vector3 force = vector(in), torque = vector(in), rate = vector(in), spin = vector(in);
        ContactDetector one(surface, known, 800.0), other(surface, known, 800.0, 0.394, 0.5);
        (void)other.update({0, 0, 1000}, {});
        const bool began = one.update(force, torque, rate, spin), stayed = other.update(force, torque, rate, spin);
        const Contact found = other.locate(force, torque, rate, spin);
        std::printf("%d %d %d %d", began, stayed, static_cast<int>(found.why), found.is_press);
        for (const Vector3& each : {found.point, found.center, found.normal, found.u, found.v})
            std::printf(" %.17g %.17g %.17g", each[0], each[1], each[2]);
        std::printf(" %.17g %.17g %.17g\n", found.uu, found.uv, found.vv);
        if (calls == 0) continue;
        const std::clock_t begin = std::clock();
        double sum = 0.0;
        for (long i = 0; i < calls; ++i) sum += other.update(force, torque, rate, spin) ? other.locate(force, torque, rate, spin).uu : 0;
        std::printf("%g s each, %g\n", static_cast<double>(std::clock() - begin) / CLOCKS_PER_SEC / static_cast<double>(calls), sum);
    }
}
