"""Scripts in URScript."""

GOOD: dict[str, str] = {
    "in_place": """def in_place():
  set_tcp(p[@T:a@])
  movej([@J0@], a=1.4, v=1.05)
  movel(p[@F1:a@], a=1.2, v=0.25, t=0, r=0.01)  # movel(p[1,2,3,0,0,0])
  movep(p[@F2:a@], a=1.2, v=0.1, r=0.02)
  movec(p[@F3:a@], p[@F5:a@], a=1.2, v=0.25)
end
""",
    "named": """def named():
  global Waypoint_1_p=p[@F0:a@]
  global Waypoint_1_q=[@J0@]
  set_tcp(p[@T:a@])
  movej(get_inverse_kin(Waypoint_1_p, qnear=Waypoint_1_q), a=1.39, v=1.04)
  movel(Waypoint_1_p, a=1.2, v=0.25)
end
""".replace("movej(get_inverse_kin(Waypoint_1_p, qnear=Waypoint_1_q), a=1.39, v=1.04)", "movej(Waypoint_1_p, a=1.39)"),
    "loops": """set_tcp(p[@T:a@])
path = [p[@F0:a@], p[@F1:a@]]
i = 0
while i < 2:
  movel(path[i], a=1.2, v=0.2)
  i = i + 1
end
if get_standard_digital_in(0):
  movej([@J3@])
elif i > 3:
  movej([@J1@])
else:
  movel(p[@F2:a@])
end
""",
    "offsets": """def offsets():
  set_tcp(p[@T:a@])
  home = p[@F0:a@]
  movej(home)
  movel(pose_trans(home, p[0, 0, -0.05, 0, 0, 0]), a=1.2)
  movel(home)
end
""",
    "feature": """def feature():
  set_tcp(p[@T:b@])
  plane_1 = p[@B:c@]
  movel(pose_trans(plane_1, p[@F0:b:c@]), a=0.5, v=0.1)
end
""",
    "degrees": """def degrees():
  set_tcp(p[0, 0, 0, 0, 0, 0])
  movej([d2r(20), d2r(-50), d2r(95), d2r(35), d2r(40), d2r(-60)], a=1)
  servoj([@J1@], 0, 0, 0.002, 0.1, 300)
  servoc(p[@F2@], a=0.5, v=0.2)
end
""",
    "functions": """def main():
  def pick():
    movel(p[@F1:a@], 1.2, 0.25, 0, 0)
  end
  set_tcp(p[@T:a@])
  pick()
  thread blink():
    set_digital_out(1, True)
  end
  run blink()
  movej([@J2@])
end
""",
    "two_tools": """def two():
  set_tcp(p[@T:a@])
  movel(p[@F0:a@])
  set_tcp(p[@T:b@])
  movel(p[@F1:b@])
end
""",
    "crlf": (
        "def crlf():\r\n  # größe\r\n  set_tcp(p[@T:a@])\r\n"
        '  textmsg("movel(p[1,2,3,4,5,6])")\r\n\tmovel( p[@F0:a@] , a = 1.2 )\r\nend\r\n'
    ),
    "joints_need_no_tool": "movej([@J0@], a=1.4, v=1.05)\nmovej(q=[@J3@])\nmovel(pose=[@J1@])\n",
    "present": "def present():\n  set_tcp(p[@T:a@])\n  movej(get_actual_joint_positions())\n  movel(p[@F0:a@])\nend\n",
    "tool_of_the_installation": "movel(p[@F0:b@], a=1.2, v=0.25)\n",
}

REFUSED: dict[str, tuple[str, int, str]] = {
    "handed_to_another_file": ("set_tcp(p[0,0,0,0,0,0])\nplace_part(p[@F0@], 0.1)\n", 2, "handed to 'place_part'"),
    "named_handed_over": ("set_tcp(p[0,0,0,0,0,0])\nwp=p[@F0@]\nplace_part(wp)\n", 3, "handed to 'place_part'"),
    "relative": (
        "set_tcp(p[0,0,0,0,0,0])\nmovel(pose_trans(get_actual_tcp_pose(), p[0,0,0.1,0,0,0]))\n",
        2,
        "relative to where",
    ),
    "added": ("set_tcp(p[0,0,0,0,0,0])\nmovel(pose_add(p[@F0@], p[0,0,0.1,0,0,0]))\n", 2, "a function"),
    "variable": ("set_tcp(p[0,0,0,0,0,0])\nh=0.1\nmovel(p[0.5, 0.1, h, 0, 3.14, 0])\n", 3, "six constants"),
    "variable_shift": (
        "set_tcp(p[0,0,0,0,0,0])\nh=0.1\nmovel(pose_trans(p[@F0@], p[0,0,h,0,0,0]))\n",
        3,
        "shift by variables",
    ),
    "by_parts": ("set_tcp(p[0,0,0,0,0,0])\na=p[@F0@]\na[2]=a[2]+0.1\nmovel(a)\n", 3, "by parts"),
    "speed": ("set_tcp(p[0,0,0,0,0,0])\nspeedl([0,0,0.1,0,0,0], 0.5, 1)\n", 2, "speed"),
    "force": (
        "set_tcp(p[0,0,0,0,0,0])\nforce_mode(p[0,0,0,0,0,0],[0,0,1,0,0,0],[0,0,5,0,0,0],2,[1,1,1,1,1,1])\n",
        2,
        "force",
    ),
    "unknown": ("set_tcp(p[0,0,0,0,0,0])\nmovel(somewhere)\n", 2, "no numbers"),
    "received": ("set_tcp(p[0,0,0,0,0,0])\np1 = socket_read_ascii_float(6)\nmovel(p1)\n", 2, "a function"),
    "parameter": ("def go(t):\n  movel(t)\nend\nset_tcp(p[0,0,0,0,0,0])\ngo(p[@F0@])\n", 2, "no numbers"),
    "tool_in_branch": (
        "set_tcp(p[@T:a@])\nif get_flag(1):\n  set_tcp(p[@T:b@])\nend\nmovel(p[@F0:a@])\n",
        5,
        "differs between",
    ),
    "conveyor": (
        "set_tcp(p[0,0,0,0,0,0])\ntrack_conveyor_linear(p[1,0,0,0,0,0], 500)\nmovel(p[@F0@])\n",
        2,
        "conveyor",
    ),
}
