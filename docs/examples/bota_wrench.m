function [wrench, stamp] = bota_wrench(address, port)
% BOTA_WRENCH  Newest wrench of sensor 0 of a running ethercat-server, in MATLAB R2020b or newer, or Octave (there
%   with the package instrument-control): Fx Fy Fz (N) Mx My Mz (Nm), NaN while the sensor has nothing new or valid,
%   and the time of the sample, s since 1970. Waits for a sample if none has come since the last call.
%     for k = 1:800, [wrench, stamp] = bota_wrench("localhost", 12001); end
%   In Simulink, in a MATLAB Function block:
%     coder.extrinsic("bota_wrench"); wrench = zeros(1, 6); wrench = bota_wrench("localhost", 12001);
%   'clear bota_wrench' disconnects. The messages: docs/protocol.md. Tested with Octave 7 only.
persistent server
if isempty(server)
  if exist("OCTAVE_VERSION", "builtin"), pkg load instrument-control, end
  server = tcpclient(address, port);
  request = uint8('{"action": "subscribe", "sensors": [0]}');
  write(server, [typecast(swapbytes(uint32(numel(request) + 1)), "uint8"), uint8(2), request]);
end
wrench = [];
while isempty(wrench) || server.NumBytesAvailable > 0
  head = uint8(read(server, 5, "uint8"));  % length (big-endian), type
  body = uint8(read(server, double(swapbytes(typecast(head(1:4), "uint32"))) - 1, "uint8"));
  if head(5) == 1  % DATA; its process data begins at byte 29, little-endian
    stamp = double(swapbytes(typecast(body(9:16), "uint64"))) / 1e9;
    wrench = double(typecast(body(34:57), "single"));
    if bitand(body(26), 3), wrench(:) = NaN; end  % REPEATED or INVALID
  end
end
end
