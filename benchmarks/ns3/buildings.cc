// Tells which rays buildings cut: reads boxes and rays in metres, and writes 0 or 1 for each ray.
#include <iostream>

#include "ns3/buildings-module.h"
#include "ns3/core-module.h"

using namespace ns3;

namespace
{
constexpr double ROOF_M = 100.0;
constexpr double ANTENNA_M = 1.5;
} // namespace

int
main()
{
    int count = 0;
    std::cin >> count;
    for (int number = 0; number < count; number++)
    {
        double west, south, east, north;
        std::cin >> west >> south >> east >> north;
        CreateObject<Building>()->SetBoundaries(Box(west, east, south, north, 0.0, ROOF_M));
    }
    std::cin >> count;
    for (int number = 0; number < count; number++)
    {
        double x1, y1, x2, y2;
        std::cin >> x1 >> y1 >> x2 >> y2;
        bool cut = false;
        for (auto each = BuildingList::Begin(); each != BuildingList::End() && !cut; ++each)
        {
            cut = (*each)->IsIntersect(Vector(x1, y1, ANTENNA_M), Vector(x2, y2, ANTENNA_M));
        }
        std::cout << cut << '\n';
    }
}
