// Vehicles that send acknowledged frames to one receiver over 802.11p in ns-3 3.37, to hold vnet's radio to it.
//
// Vehicle 0 receives at the origin; the others stand on a circle around it, and all hear each other. Each sends a
// frame of the given size (headers included) at every multiple of the interval, plus a random part of it; with an
// interval of 0 it always has frames to send. Receptions are lost at random with the given probability,
// acknowledgements included. Writes JSON: frames that were transmitted at least once, acknowledgements that their
// senders received, transmissions, and frames that vehicle 0 received.

#include <iostream>

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
constexpr uint32_t SATURATED_QUEUE = 3; // few, as ns-3 drops frames that wait for 500 ms

uint64_t g_acked = 0;
uint64_t g_begun = 0;
uint64_t g_transmitted = 0;
uint64_t g_received = 0;
uint32_t g_bytes = 300;
bool g_saturated = false;
Ptr<UniformRandomVariable> g_uniform;
std::vector<Ptr<NetDevice>> g_devices;

void
SendOne(uint32_t node)
{
    g_devices[node]->Send(Create<Packet>(g_bytes - OVERHEAD_BYTES), g_devices[0]->GetAddress(), PROTOCOL);
}

void
SendRegularly(uint32_t node, Time start, Time interval)
{
    Simulator::Schedule(start + interval * g_uniform->GetValue() - Simulator::Now(), &SendOne, node);
    Simulator::Schedule(start + interval - Simulator::Now(), &SendRegularly, node, start + interval, interval);
}

bool
Receive(Ptr<NetDevice>, Ptr<const Packet>, uint16_t, const Address&)
{
    g_received++;
    return true;
}

void
Transmitted(uint32_t node, Ptr<const Packet> packet, double)
{
    WifiMacHeader header;
    packet->PeekHeader(header);
    if (!header.IsData())
    {
        return;
    }
    g_transmitted++;
    if (!header.IsRetry())
    {
        g_begun++;
        if (g_saturated)
        {
            Simulator::ScheduleNow(&SendOne, node);
        }
    }
}

void
Heard(uint32_t node, Ptr<const Packet> packet, uint16_t, WifiTxVector, MpduInfo, SignalNoiseDbm, uint16_t)
{
    WifiMacHeader header;
    packet->PeekHeader(header);
    g_acked += header.IsAck() && header.GetAddr1() == Mac48Address::ConvertFrom(g_devices[node]->GetAddress());
}
} // namespace

int
main(int argc, char* argv[])
{
    uint32_t senders = 1;
    double seconds = 20;
    double intervalMs = 0;
    double loss = 0;
    double radius = 50;
    uint32_t seed = 1;
    CommandLine command;
    command.AddValue("senders", "number of senders", senders);
    command.AddValue("seconds", "length of the run", seconds);
    command.AddValue("interval_ms", "time between two frames of a sender; 0: always one more", intervalMs);
    command.AddValue("loss", "probability that a frame is lost at a receiver", loss);
    command.AddValue("bytes", "size of a frame on air", g_bytes);
    command.AddValue("radius", "distance of the senders from the receiver in m", radius);
    command.AddValue("seed", "seed of the random numbers", seed);
    command.Parse(argc, argv);
    RngSeedManager::SetSeed(seed);
    g_saturated = intervalMs == 0;
    g_uniform = CreateObject<UniformRandomVariable>();

    NodeContainer nodes(senders + 1);
    auto places = CreateObject<ListPositionAllocator>();
    places->Add(Vector(0, 0, 0));
    for (uint32_t i = 0; i < senders; i++)
    {
        const double angle = 2 * M_PI * i / senders;
        places->Add(Vector(radius * std::cos(angle), radius * std::sin(angle), 0));
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
    for (uint32_t i = 0; i <= senders; i++)
    {
        g_devices.push_back(devices.Get(i));
        auto device = DynamicCast<WifiNetDevice>(devices.Get(i));
        if (i == 0)
        {
            device->SetReceiveCallback(MakeCallback(&Receive));
        }
        else
        {
            device->GetPhy()->TraceConnectWithoutContext("PhyTxBegin", MakeBoundCallback(&Transmitted, i));
            device->GetPhy()->TraceConnectWithoutContext("MonitorSnifferRx", MakeBoundCallback(&Heard, i));
        }
        if (loss > 0)
        {
            auto errors = CreateObject<RateErrorModel>();
            errors->SetUnit(RateErrorModel::ERROR_UNIT_PACKET);
            errors->SetRate(loss);
            device->GetPhy()->SetPostReceptionErrorModel(errors);
        }
    }
    for (uint32_t i = 1; i <= senders; i++)
    {
        if (g_saturated)
        {
            for (uint32_t frame = 0; frame < SATURATED_QUEUE; frame++)
            {
                Simulator::Schedule(MicroSeconds(100 * i + frame), &SendOne, i);
            }
        }
        else
        {
            Simulator::Schedule(Seconds(0), &SendRegularly, i, Seconds(0), Seconds(intervalMs / 1000));
        }
    }
    Simulator::Stop(Seconds(seconds));
    Simulator::Run();
    Simulator::Destroy();
    std::cout << "{\"begun\": " << g_begun << ", \"acked\": " << g_acked
              << ", \"transmitted\": " << g_transmitted << ", \"received\": " << g_received << "}\n";
    return 0;
}
