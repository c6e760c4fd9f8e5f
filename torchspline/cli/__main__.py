from torchspline.cli import main

main()
