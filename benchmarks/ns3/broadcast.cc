// Vehicles that broadcast over 802.11p in ns-3 3.37, to hold vnet's radio to it.
//
// Reads from standard input: the number of vehicles N, N pairs x y (m), the number of frames F, and F lines
// "time_ns sender" in order of time. Writes JSON: how many frames each sent, how many of them each other received
// (row: sender), the part of the time in which each one's medium was not idle, and what the simulation took.

#include <chrono>
#include <ctime>
#include <iostream>
#include <vector>

#include "ns3/core-module.h"
#include "ns3/mobility-module.h"
#include "ns3/network-module.h"
#include "ns3/propagation-module.h"
#include "ns3/wave-module.h"
#include "ns3/wifi-module.h"

using namespace ns3;

namespace
{
// What a frame has on air beside its payload: header of QoS data (26), LLC and SNAP (8), check sequence (4).
constexpr uint32_t OVERHEAD_BYTES = 38;
constexpr uint16_t PROTOCOL = 0x88dc;

std::vector<std::vector<uint64_t>> g_received;
std::vector<uint64_t> g_sent;
std::vector<int64_t> g_busyNs;

bool
Receive(uint32_t node, Ptr<NetDevice>, Ptr<const Packet> packet, uint16_t, const Address&)
{
    uint32_t sender = 0;
    packet->CopyData(reinterpret_cast<uint8_t*>(&sender), sizeof(sender));
    g_received[sender][node]++;
    return true;
}

void
Send(Ptr<NetDevice> device, uint32_t node, uint32_t bytes)
{
    std::vector<uint8_t> payload(bytes - OVERHEAD_BYTES);
    *reinterpret_cast<uint32_t*>(payload.data()) = node;
    device->Send(Create<Packet>(payload.data(), payload.size()), Mac48Address::GetBroadcast(), PROTOCOL);
}

void
CountSent(uint32_t node, Ptr<const Packet>, double)
{
    g_sent[node]++;
}

void
CountState(uint32_t node, Time, Time duration, WifiPhyState state)
{
    if (state != WifiPhyState::IDLE)
    {
        g_busyNs[node] += duration.GetNanoSeconds();
    }
}

template <typename T>
void
Print(const char* name, const std::vector<T>& row)
{
    std::cout << "\"" << name << "\": [";
    for (size_t i = 0; i < row.size(); i++)
    {
        std::cout << (i ? ", " : "") << row[i];
    }
    std::cout << "]";
}
} // namespace

int
main(int argc, char* argv[])
{
    bool fading = true;
    uint32_t bytes = 300;
    double seconds = 60;
    uint32_t seed = 1;
    CommandLine command;
    command.AddValue("fading", "whether there is Nakagami fading", fading);
    command.AddValue("bytes", "size of a frame on air", bytes);
    command.AddValue("seconds", "length of the run", seconds);
    command.AddValue("seed", "seed of the random numbers", seed);
    command.Parse(argc, argv);
    RngSeedManager::SetSeed(seed);

    uint32_t count = 0;
    std::cin >> count;
    NodeContainer nodes(count);
    auto places = CreateObject<ListPositionAllocator>();
    for (uint32_t i = 0; i < count; i++)
    {
        double x, y;
        std::cin >> x >> y;
        places->Add(Vector(x, y, 0));
    }
    MobilityHelper mobility;
    mobility.SetPositionAllocator(places);
    mobility.SetMobilityModel("ns3::ConstantPositionMobilityModel");
    mobility.Install(nodes);

    YansWifiChannelHelper channel;
    channel.SetPropagationDelay("ns3::ConstantSpeedPropagationDelayModel");
    channel.AddPropagationLoss("ns3::LogDistancePropagationLossModel",
                               "Exponent", DoubleValue(2.0),
                               "ReferenceDistance", DoubleValue(1.0),
                               "ReferenceLoss", DoubleValue(47.86));
    if (fading) // its own defaults: m 1.5 up to 80 m, 0.75 beyond
    {
        channel.AddPropagationLoss("ns3::NakagamiPropagationLossModel");
    }
    YansWavePhyHelper phy = YansWavePhyHelper::Default();
    phy.SetChannel(channel.Create());
    phy.Set("TxPowerStart", DoubleValue(20));
    phy.Set("TxPowerEnd", DoubleValue(20));
    QosWaveMacHelper mac = QosWaveMacHelper::Default();
    Wifi80211pHelper wifi = Wifi80211pHelper::Default();
    wifi.SetRemoteStationManager("ns3::ConstantRateWifiManager",
                                 "DataMode", StringValue("OfdmRate6MbpsBW10MHz"),
                                 "ControlMode", StringValue("OfdmRate6MbpsBW10MHz"),
                                 "NonUnicastMode", StringValue("OfdmRate6MbpsBW10MHz"));
    NetDeviceContainer devices = wifi.Install(phy, mac, nodes);

    g_received.assign(count, std::vector<uint64_t>(count, 0));
    g_sent.assign(count, 0);
    g_busyNs.assign(count, 0);
    for (uint32_t i = 0; i < count; i++)
    {
        devices.Get(i)->SetReceiveCallback(MakeBoundCallback(&Receive, i));
        Ptr<WifiPhy> own = DynamicCast<WifiNetDevice>(devices.Get(i))->GetPhy();
        own->TraceConnectWithoutContext("PhyTxBegin", MakeBoundCallback(&CountSent, i));
        own->GetState()->TraceConnectWithoutContext("State", MakeBoundCallback(&CountState, i));
    }
    uint32_t frames = 0;
    std::cin >> frames;
    for (uint32_t i = 0; i < frames; i++)
    {
        int64_t time = 0;
        uint32_t sender = 0;
        std::cin >> time >> sender;
        Simulator::ScheduleWithContext(sender, NanoSeconds(time), &Send, devices.Get(sender), sender, bytes);
    }
    Simulator::Stop(Seconds(seconds + 1)); // what waits is sent
    const auto start = std::chrono::steady_clock::now();
    const std::clock_t cpu = std::clock();
    Simulator::Run();
    const double cpuSeconds = double(std::clock() - cpu) / CLOCKS_PER_SEC;
    const std::chrono::duration<double> wall = std::chrono::steady_clock::now() - start;
    Simulator::Destroy();

    std::cout << "{\"wall_s\": " << wall.count() << ", \"cpu_s\": " << cpuSeconds << ", ";
    Print("sent", g_sent);
    std::vector<double> busy;
    for (int64_t ns : g_busyNs)
    {
        busy.push_back(ns / (seconds * 1e9));
    }
    std::cout << ", ";
    Print("busy", busy);
    std::cout << ", \"received\": [";
    for (uint32_t i = 0; i < count; i++)
    {
        std::cout << (i ? ", " : "") << "[";
        for (uint32_t j = 0; j < count; j++)
        {
            std::cout << (j ? ", " : "") << g_received[i][j];
        }
        std::cout << "]";
    }
    std::cout << "]}\n";
    return 0;
}
